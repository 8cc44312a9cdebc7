// Fitness over evaluations: best so far and median of the generation, below them the step size sigma.

import { count, h, number, s, ticks } from "./elements.js";

const LEFT = 46, RIGHT = 12, TOP = 12, GAP = 22, BOTTOM = 34;

/** A run's history that grows: columns of plain arrays. */
export class History {
  constructor(columns) {
    this.columns = columns;
  }

  get length() {
    return this.columns.generation.length;
  }

  /** Takes new rows in place of those from `first` on; false where rows in between are missing. */
  take(rows, first) {
    const { generation } = this.columns;
    let kept = generation.length;
    while (kept > 0 && generation[kept - 1] > first) kept--;
    if (first > 0 && generation[kept - 1] !== first) return false;
    const names = Object.keys(this.columns);
    for (const name of names) this.columns[name].length = kept;
    for (const row of rows) names.forEach((name, k) => this.columns[name].push(row[k]));
    return true;
  }
}

/** Draws one or two histories; `unit` is the fitness's, `compact` leaves out axis labels and sigma. */
export class Curves {
  constructor(element, histories, { unit = "", names = [""], compact = false } = {}) {
    this.element = element;
    this.histories = histories;
    this.options = { unit, names, compact };
    this.chosen = null; // evaluations under the pointer
    element.classList.add("curves");
    element.classList.toggle("pair", histories.length > 1);
    this.svg = s("svg", { role: "img", tabindex: compact ? null : "0" });
    this.tip = h("div", { class: "tip", hidden: true });
    element.replaceChildren(this.svg, this.tip);
    if (!compact) {
      element.prepend(this.#legend());
      this.svg.addEventListener("pointermove", (event) => this.#point(event));
      this.svg.addEventListener("pointerdown", (event) => this.#point(event));
      this.svg.addEventListener("pointerleave", () => this.#choose(null));
      this.svg.addEventListener("blur", () => this.#choose(null));
      this.svg.addEventListener("keydown", (event) => this.#key(event));
    }
    this.observer = new ResizeObserver(() => this.draw());
    this.observer.observe(element);
  }

  end() {
    this.observer.disconnect();
  }

  #legend() {
    const key = (kind, k, text) => h("span", { class: `key ${kind} run${k}` }, text);
    if (this.histories.length === 1) {
      return h("div", { class: "legend" }, key("best", 0, "best so far"), key("median", 0, "median"), key("sigma", 0, "step size σ"));
    }
    const names = this.options.names.map((name, k) => key("best", k, name));
    return h("div", { class: "legend" }, names, h("span", { class: "muted" }, "thick: best so far; thin: median; below: step size σ"));
  }

  draw() {
    const { compact } = this.options;
    const width = this.element.clientWidth;
    if (width < 40) return;
    const height = compact ? 64 : Math.round(Math.min(Math.max(width * 0.48, 260), 400));
    const left = compact ? 2 : LEFT, right = compact ? 2 : RIGHT, top = compact ? 4 : TOP;
    const lower = compact ? 0 : Math.round(height * 0.2); // of sigma
    const upper = height - top - (compact ? 4 : BOTTOM + GAP + lower);
    const last = Math.max(1, ...this.histories.map((history) => history.columns.evaluations.at(-1) ?? 1));
    const [low, high] = this.#range();
    const x = (evaluations) => left + (evaluations / last) * (width - left - right);
    const y = (fitness) => top + upper - ((Math.max(fitness, low) - low) / (high - low)) * upper;
    const largest = Math.max(1e-12, ...this.histories.flatMap((one) => maximum(one.columns.sigma)));
    const bottom = height - BOTTOM;
    const z = (sigma) => bottom - (sigma / largest) * lower;
    this.scales = { x, y, z, last, left, right, top, bottom: compact ? height : bottom, width };
    const parts = compact ? [] : this.#axes({ width, height, upper, lower, low, high, largest, last, x, y, z });
    this.histories.forEach((history, k) => {
      const { evaluations, best, median, sigma } = history.columns;
      if (!compact && k === 0 && this.histories.length === 1) {
        parts.push(s("path", { class: "under", d: `${line(evaluations, best, x, y)}V${top + upper}H${x(evaluations[0] ?? 0)}Z` }));
      }
      parts.push(s("path", { class: `line median run${k}`, d: line(evaluations, median, x, y) }));
      parts.push(s("path", { class: `line best run${k}`, d: line(evaluations, best, x, y) }));
      if (!compact) parts.push(s("path", { class: `line sigma run${k}`, d: line(evaluations, sigma, x, z) }));
      const end = evaluations.length - 1;
      if (end >= 0) parts.push(s("circle", { class: `dot best run${k}`, cx: x(evaluations[end]), cy: y(best[end]), r: 3 }));
    });
    this.cross = s("g", { class: "cross" });
    this.svg.replaceChildren(...parts, this.cross);
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.svg.setAttribute("width", width);
    this.svg.setAttribute("height", height);
    this.svg.setAttribute("aria-label", this.#words());
    this.#choose(this.chosen);
  }

  #words() {
    return this.histories.map((history, k) => {
      const { best, evaluations } = history.columns;
      const name = this.options.names[k] ? `${this.options.names[k]}: ` : "";
      if (!best.length) return `${name}no generation yet`;
      return `${name}best fitness ${number(best.at(-1))} ${this.options.unit} after ${evaluations.at(-1)} evaluations`;
    }).join("; ");
  }

  #range() {
    const best = this.histories.flatMap((one) => one.columns.best.filter(Number.isFinite));
    const median = this.histories.flatMap((one) => one.columns.median.filter(Number.isFinite)).sort((a, b) => a - b);
    if (!best.length) return [0, 1];
    const low = Math.min(0, minimum(best), median[Math.floor(median.length * 0.02)] ?? 0);
    const high = Math.max(maximum(best), 0);
    const room = (high - low || 1) * 0.06;
    return [low < 0 ? low - room : 0, high + room];
  }

  #axes({ width, height, upper, lower, low, high, largest, last, x, y, z }) {
    const parts = [], { unit } = this.options, bottom = height - BOTTOM;
    const across = ticks(0, last, Math.max(2, Math.floor(width / 130)));
    for (const at of across.at) {
      parts.push(s("line", { class: "grid", x1: x(at), x2: x(at), y1: TOP, y2: bottom }));
      const anchor = x(at) > width - 30 ? "end" : "middle";
      parts.push(s("text", { x: x(at), y: bottom + 15, "text-anchor": anchor }, count(at)));
    }
    const up = ticks(low, high, Math.floor(upper / 45));
    for (const at of up.at) {
      parts.push(s("line", { class: Math.abs(at) < 1e-12 ? "zero" : "grid", x1: LEFT, x2: width - RIGHT, y1: y(at), y2: y(at) }));
      parts.push(s("text", { x: LEFT - 7, y: y(at) + 4, "text-anchor": "end" }, number(at, up.digits)));
    }
    for (const at of [0, ticks(0, largest, 1).at.at(-1)]) {
      parts.push(s("line", { class: "grid", x1: LEFT, x2: width - RIGHT, y1: z(at), y2: z(at) }));
      parts.push(s("text", { x: LEFT - 7, y: z(at) + 4, "text-anchor": "end" }, String(Number(at.toPrecision(2)))));
    }
    parts.push(s("text", { class: "axis", x: width - RIGHT, y: height - 3, "text-anchor": "end" }, "evaluations"));
    parts.push(this.#turned(11, TOP + upper / 2, unit ? `fitness [${unit}]` : "fitness"));
    parts.push(this.#turned(11, bottom - lower / 2, "σ"));
    return parts;
  }

  #turned(x, y, text) {
    return s("text", { class: "axis", "text-anchor": "middle", transform: `translate(${x} ${y}) rotate(-90)` }, text);
  }

  #point(event) {
    const box = this.svg.getBoundingClientRect();
    const { left, right, width, last } = this.scales;
    this.#choose(((event.clientX - box.left - left) / (width - left - right)) * last);
  }

  #key(event) {
    const steps = { ArrowLeft: -1, ArrowRight: 1, PageDown: -20, PageUp: 20, Home: -1e9, End: 1e9 };
    if (!(event.key in steps)) return;
    event.preventDefault();
    const { evaluations } = this.histories[0].columns;
    const k = nearest(evaluations, this.chosen ?? evaluations.at(-1) ?? 0) + steps[event.key];
    this.#choose(evaluations[Math.min(Math.max(k, 0), evaluations.length - 1)] ?? null);
  }

  #choose(at) {
    this.chosen = at;
    this.cross.replaceChildren();
    const shown = at !== null && this.histories.some((history) => history.length > 0);
    this.tip.hidden = !shown;
    if (!shown) return;
    const { x, y, z, top, bottom, width } = this.scales;
    const lines = [];
    let place = 0;
    this.histories.forEach((history, k) => {
      if (!history.length) return;
      const { generation, evaluations, best, median, sigma } = history.columns;
      const i = nearest(evaluations, at);
      place = x(evaluations[i]);
      this.cross.append(
        s("line", { x1: place, x2: place, y1: top, y2: bottom }),
        s("circle", { class: `dot median run${k}`, cx: place, cy: y(median[i] ?? 0), r: 3.5 }),
        s("circle", { class: `dot best run${k}`, cx: place, cy: y(best[i]), r: 3.5 }),
        s("circle", { class: `dot sigma run${k}`, cx: place, cy: z(sigma[i] ?? 0), r: 3 }),
      );
      const name = this.options.names[k];
      lines.push(
        h("b", {}, `${name ? `${name}, ` : ""}generation ${count(generation[i])}`),
        h("span", { class: `key best run${k}` }, `best ${number(best[i], 3)}`),
        h("span", { class: `key median run${k}` }, `median ${number(median[i], 3)}`),
        h("span", { class: `key sigma run${k}` }, `σ ${number(sigma[i], 4)}`),
      );
    });
    this.tip.replaceChildren(...lines);
    const side = place > width / 2 ? place - this.tip.offsetWidth - 12 : place + 12;
    this.tip.style.left = `${Math.max(0, side)}px`;
    const under = this.svg.getBoundingClientRect().top - this.element.getBoundingClientRect().top;
    this.tip.style.top = `${under + top + 4}px`;
  }
}

function line(xs, ys, x, y) {
  let d = "", drawn = false;
  for (let k = 0; k < xs.length; k++) {
    if (!Number.isFinite(ys[k])) {
      drawn = false;
      continue;
    }
    d += `${drawn ? "L" : "M"}${x(xs[k]).toFixed(1)} ${y(ys[k]).toFixed(1)}`;
    drawn = true;
  }
  return d || "M0 0";
}

const minimum = (values) => values.reduce((a, b) => (b < a ? b : a), Infinity);
const maximum = (values) => values.reduce((a, b) => (b > a ? b : a), -Infinity);

/** Index of the value next to `at` in ascending `values`. */
function nearest(values, at) {
  let low = 0, high = values.length - 1;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (values[middle] < at) low = middle + 1;
    else high = middle;
  }
  return low > 0 && at - values[low - 1] < values[low] - at ? low - 1 : low;
}
