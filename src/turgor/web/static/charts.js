// Strip charts: pressure, area ratio, velocity and spring commands over time, in step with the player.

import { STRAIN_MAP, number, shade } from "./draw.js";

const GUTTER = 46; // [px], for the numbers of the axes
const RIGHT = 8;
const HEAD = 20; // above each strip
const STRIP = 50;
const AXIS = 22; // below the last

/** The charts of one or two replays in `element`; `onSeek(time [s])` is called where they are clicked or dragged. */
export class Charts {
  #abort = new AbortController();

  constructor(element, replays, { onSeek = () => {} } = {}) {
    this.replays = replays;
    this.element = element;
    this.duration = Math.max(...replays.map((replay) => replay.duration), 1e-9);
    this.strips = this.#strips();
    this.canvas = document.createElement("canvas"); // all that does not move
    this.canvas.className = "player-chart";
    this.canvas.setAttribute("role", "img");
    this.moving = document.createElement("canvas"); // over it
    this.moving.className = "player-playhead";
    this.moving.setAttribute("aria-hidden", "true");
    const names = this.strips.map((strip) => strip.name).join(", ");
    this.canvas.setAttribute("aria-label", `Charts over time: ${names}. The slider moves through time.`);
    this.height = this.strips.reduce((sum, strip) => sum + HEAD + strip.height, AXIS);
    this.canvas.style.height = this.moving.style.height = `${this.height}px`;
    element.append(this.canvas, this.moving);
    this.resizing = new ResizeObserver(() => this.redraw());
    this.resizing.observe(this.canvas);
    const { signal } = this.#abort;
    const seek = (event) => {
      const box = this.canvas.getBoundingClientRect();
      const share = (event.clientX - box.left - GUTTER) / Math.max(box.width - GUTTER - RIGHT, 1);
      onSeek(Math.min(Math.max(share, 0), 1) * this.duration);
    };
    this.canvas.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      this.canvas.setPointerCapture(event.pointerId);
      seek(event);
    }, { signal });
    this.canvas.addEventListener("pointermove", (event) => event.buttons & 1 && seek(event), { signal });
  }

  destroy() {
    this.#abort.abort();
    this.resizing.disconnect();
    this.canvas.remove();
    this.moving.remove();
  }

  #strips() {
    const lines = (name, unit, digits, of) => {
      const curves = this.replays.flatMap((replay, which) => of(replay).map((curve) => ({ ...curve, which, replay })));
      return curves.length ? [{ name, unit, digits, height: STRIP, curves, range: spanOf(curves) }] : [];
    };
    const chambers = (replay, values, factor) =>
      replay.header.chambers.map((_, c) => ({ at: (t) => factor * values[t * replay.chambers + c] }));
    const strips = [
      ...lines("pressure", "kPa", 1, (replay) => chambers(replay, replay.pressure, 1e-3)),
      ...lines("area ratio", "", 2, (replay) => chambers(replay, replay.areaRatio, 1)),
      ...lines("velocity", "m/s", 2, (replay) => [
        { at: (t) => replay.velocity[2 * t], faint: true },
        { at: (t) => replay.speed[t] },
      ]),
    ];
    this.replays.forEach((replay, which) => {
      if (!replay.springs) return;
      const name = "spring commands" + (this.replays.length > 1 ? ` ${"AB"[which]}` : "");
      strips.push({ name, unit: "of L0", heat: replay, which, height: Math.min(Math.max(3 * replay.springs, 36), 72) });
    });
    return strips;
  }

  /** Draws all anew, after a change of size or colours. */
  redraw() {
    const width = this.canvas.clientWidth;
    if (!width) return;
    const ratio = window.devicePixelRatio || 1;
    for (const canvas of [this.canvas, this.moving]) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(this.height * ratio);
    }
    const style = getComputedStyle(this.canvas);
    const colour = (name) => style.getPropertyValue(name).trim();
    this.colours = {
      text: colour("--fg"), faint: colour("--muted"), line: colour("--line"), curves: [colour("--a"), colour("--b")],
    };
    this.width = width;
    this.drawn = 0; // [px], where the line was
    this.ratio = ratio;
    const context = this.canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, this.height);
    let top = 0;
    for (const strip of this.strips) {
      strip.top = top + HEAD;
      this.#drawFrame(context, strip);
      if (strip.heat) this.#drawHeat(context, strip);
      else for (const curve of strip.curves) this.#drawCurve(context, strip, curve);
      top = strip.top + strip.height;
    }
    this.#drawAxis(context, top);
    this.draw(this.time ?? 0);
  }

  /** Shows the time [s]: a line through all charts, and the values there. */
  draw(time) {
    this.time = time;
    if (!this.width) return;
    const context = this.moving.getContext("2d");
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    const x = this.#x(time);
    // only where something was
    context.clearRect(this.drawn - 6, 0, 12, this.height);
    for (const strip of this.strips) context.clearRect(this.width / 2, strip.top - HEAD, this.width / 2, HEAD);
    this.drawn = x;
    context.fillStyle = this.colours.text;
    const last = this.strips.at(-1);
    context.fillRect(x - 0.75, HEAD - 4, 1.5, (last ? last.top + last.height : 0) - HEAD + 8);
    context.font = "12px system-ui, sans-serif";
    context.textBaseline = "alphabetic";
    for (const strip of this.strips) {
      if (strip.heat) continue;
      let right = this.width - RIGHT;
      context.textAlign = "right";
      for (const curve of strip.curves.filter((c) => !c.faint).reverse()) {
        const value = curve.at(curve.replay.stepAt(time));
        const text = `${number(value, strip.digits)}${strip.unit && ` ${strip.unit}`}`;
        context.fillStyle = this.colours.curves[curve.which];
        context.fillText(text, right, strip.top - 6);
        right -= context.measureText(text).width + 12;
        context.beginPath();
        context.arc(x, this.#y(strip, value), 3, 0, 2 * Math.PI);
        context.fill();
      }
    }
  }

  #x(time) {
    return GUTTER + (time / this.duration) * (this.width - GUTTER - RIGHT);
  }

  #y(strip, value) {
    const [low, high] = strip.range;
    return strip.top + strip.height * (1 - (value - low) / (high - low));
  }

  #drawFrame(context, strip) {
    const { text, faint, line } = this.colours;
    const width = this.width - GUTTER - RIGHT;
    context.font = "600 12px system-ui, sans-serif";
    context.textBaseline = "alphabetic";
    context.textAlign = "left";
    context.fillStyle = text;
    context.fillText(strip.name, GUTTER, strip.top - 6);
    const past = GUTTER + context.measureText(strip.name).width + 6;
    context.font = "11px system-ui, sans-serif";
    context.fillStyle = faint;
    const { spring_range: range } = strip.heat?.header ?? {};
    const unit = range ? `${Math.round(100 * (range[0] - 1))}% (blue) to +${Math.round(100 * (range[1] - 1))}% (red)` : strip.unit;
    if (unit) context.fillText(range ? unit.replace("-", "−") : `[${unit}]`, past, strip.top - 6, this.width - RIGHT - past);
    context.strokeStyle = line;
    context.lineWidth = 1;
    context.strokeRect(GUTTER - 0.5, strip.top - 0.5, width + 1, strip.height + 1);
    context.textAlign = "right";
    context.textBaseline = "middle";
    const ends = strip.heat ? [strip.heat.springs - 1, 0] : strip.range;
    ends.forEach((value, k) => {
      const y = strip.top + (k ? 5 : strip.height - 5);
      context.fillText(strip.heat ? String(value) : number(value, strip.digits), GUTTER - 6, y);
    });
    if (!strip.heat && strip.range[0] < 0 && strip.range[1] > 0) {
      context.fillStyle = line;
      context.fillRect(GUTTER, this.#y(strip, 0), width, 1);
    }
  }

  #drawCurve(context, strip, { at, replay, which, faint }) {
    context.strokeStyle = this.colours.curves[which];
    context.globalAlpha = faint ? 0.35 : 1;
    context.lineWidth = faint ? 1 : 1.6;
    context.lineJoin = "round";
    context.save();
    context.beginPath();
    context.rect(GUTTER, strip.top, this.width - GUTTER - RIGHT, strip.height);
    context.clip();
    context.beginPath();
    for (let t = 0; t <= replay.steps; t++) context.lineTo(this.#x(t * replay.dt), this.#y(strip, at(t)));
    context.stroke();
    context.restore();
    context.globalAlpha = 1;
  }

  #drawHeat(context, strip) {
    const replay = strip.heat;
    const { rest, spring_range: range } = replay.header;
    const width = this.width - GUTTER - RIGHT;
    const row = strip.height / replay.springs;
    const columns = Math.max(Math.ceil((width * replay.duration) / this.duration), 1);
    for (let column = 0; column < columns; column++) {
      const t = Math.min(Math.floor(((column + 0.5) / columns) * (replay.steps + 1)), replay.steps);
      for (let j = 0; j < replay.springs; j++) {
        context.fillStyle = shade(STRAIN_MAP, replay.rest[t * replay.springs + j] / rest[j], range);
        context.fillRect(GUTTER + column, strip.top + j * row, Math.min(1.2, width - column), row + 0.2);
      }
    }
  }

  #drawAxis(context, top) {
    const least = (60 / Math.max(this.width - GUTTER - RIGHT, 60)) * this.duration;
    const power = 10 ** Math.floor(Math.log10(least));
    const spacing = [1, 2, 5, 10].map((m) => m * power).find((d) => d >= least);
    context.fillStyle = this.colours.faint;
    context.font = "11px system-ui, sans-serif";
    context.textBaseline = "top";
    context.textAlign = "center";
    for (let k = 0; k * spacing <= this.duration + 1e-9; k++) {
      const x = this.#x(k * spacing);
      context.fillRect(x - 0.5, top + 1, 1, 4);
      context.fillText(`${number(k * spacing)} s`, Math.min(x, this.width - 14), top + 7);
    }
  }
}

/** Lowest and highest value of all curves but the faint ones, with some air. */
function spanOf(curves) {
  let [low, high] = [Infinity, -Infinity];
  for (const { at, replay, faint } of curves) {
    if (faint) continue;
    for (let t = 0; t <= replay.steps; t++) {
      const value = at(t);
      if (value < low) low = value;
      if (value > high) high = value;
    }
  }
  if (!(high > low)) return [Number.isFinite(low) ? low - 0.5 : 0, Number.isFinite(low) ? low + 0.5 : 1];
  const air = 0.06 * (high - low);
  return [low - air, high + air];
}
