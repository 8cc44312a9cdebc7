// The player: one or two replays on a canvas, with controls, charts and keys. It fetches nothing and shares nothing.

import { Charts } from "./charts.js";
import {
  BODY_HEIGHT, Camera, PALETTES, PRESSURE_MAP, STRAIN_MAP, World, bodyScale, centreAt, drawBody, number, shade,
} from "./draw.js";

const SPEEDS = [1 / 8, 1 / 4, 1 / 2, 1, 2, 4, 8];
const CAMERA_SLACK = 0.22; // [1], furthest that the body's centre gets from the camera's / the picture's size
const ZOOMS = [0.05, 20];
const GHOST = 0.5; // [1], opacity
const FAR = 0.3; // [1], how far a camera on two bodies backs off at most, of its scale

export const SHORTCUTS = [
  ["Space", "play or pause"],
  ["← →", "one step back or on"],
  ["Shift + ← →", "ten steps back or on"],
  ["Home, End", "to the start or the end"],
  ["< >", "slower or faster"],
  ["+ −", "zoom in or out"],
  ["0", "the whole body again, followed"],
  ["F", "camera follows or stands free"],
  ["G", "two replays: side by side or as ghosts"],
  ["C", "charts on or off"],
  ["?", "this list"],
];

const ICONS = {
  start: "M5 5h2v14H5zM19 5v14l-10-7z",
  back: "M16 5v14l-9-7z",
  play: "M7 4v16l13-8z",
  pause: "M6 4h4v16H6zM14 4h4v16h-4z",
  on: "M8 5v14l9-7z",
  end: "M17 5h2v14h-2zM5 5v14l10-7z",
  in: "M11 5h2v6h6v2h-6v6h-2v-6H5v-2h6z",
  out: "M5 11h14v2H5z",
};

export class Player {
  #abort = new AbortController();
  #request = 0;
  #before = null; // [ms], when the last frame was drawn
  #times = []; // [ms], of the last frames while playing
  #pointers = new Map();

  /**
   * `replays`: one or two of `loadReplay`. `options`: mode "side" or "ghost", autoplay, loop, charts (shown from the
   * start), title, keyboard (whether it listens on the whole page; else only where it has the focus).
   */
  constructor(element, replays, options = {}) {
    if (replays.length < 1 || replays.length > 2) throw new Error(`player: expected 1 or 2 replays; got ${replays.length}`);
    this.created = performance.now();
    this.stats = { firstFrame: null, frames: 0, fps: 0, drawing: 0 }; // [ms], [1], [1/s], [ms]
    this.replays = replays;
    this.worlds = replays.map((replay) => new World(replay.header.scene));
    this.options = { mode: "side", autoplay: false, loop: false, charts: true, title: "", keyboard: true, ...options };
    this.mode = this.options.mode;
    this.duration = Math.max(...replays.map((replay) => replay.duration));
    this.dt = Math.min(...replays.map((replay) => replay.dt));
    this.steps = Math.round(this.duration / this.dt);
    this.time = 0; // [s]
    this.speed = 1;
    this.playing = false;
    this.follow = true;
    this.zoom = 1;
    this.free = [0, 0]; // [m], where a free camera stands
    this.#build(element);
    this.#listen();
    this.#retheme();
    this.showCharts(this.options.charts);
    this.#resize();
    this.#show();
    if (this.options.autoplay && !matchMedia("(prefers-reduced-motion: reduce)").matches) this.play();
  }

  /** Takes everything back: elements, listeners, frames. */
  destroy() {
    this.#abort.abort();
    cancelAnimationFrame(this.#request);
    this.resizing.disconnect();
    this.theming.disconnect();
    this.charts?.destroy();
    this.root.remove();
  }

  // --- time ---

  get step() {
    return Math.round(this.time / this.dt);
  }

  play() {
    if (this.playing) return;
    if (this.time >= this.duration - 1e-9) this.time = 0;
    this.playing = true;
    this.#before = null;
    this.#times = [];
    this.#show();
  }

  pause() {
    if (!this.playing) return;
    this.playing = false;
    this.seek(this.step * this.dt);
  }

  toggle() {
    if (this.playing) this.pause();
    else this.play();
  }

  /** Goes to a time [s]. */
  seek(time) {
    this.time = Math.min(Math.max(time, 0), this.duration);
    this.#show();
  }

  /** Goes some steps on, or back, and stands there. */
  stepBy(steps) {
    this.pause();
    this.seek((this.step + steps) * this.dt);
  }

  setSpeed(speed) {
    this.speed = speed;
    this.parts.speed.value = String(speed);
    this.#show();
  }

  changeSpeed(by) {
    const at = SPEEDS.indexOf(this.speed);
    this.setSpeed(SPEEDS[Math.min(Math.max(at + by, 0), SPEEDS.length - 1)]);
  }

  // --- what is seen ---

  setFollow(follow) {
    if (this.follow && !follow) {
      const { camera } = this.views[0];
      this.free = [camera.x, camera.y];
      this.zoom = camera.scale / this.#scale(this.views[0]);
    }
    this.follow = follow;
    this.root.classList.toggle("player-free", !follow);
    this.#show();
  }

  /** Zooms by a factor; where the camera is free, the point x, y [px] of the canvas stays. */
  zoomBy(factor, x = null, y = null) {
    const zoom = Math.min(Math.max(this.zoom * factor, ZOOMS[0]), ZOOMS[1]);
    if (!this.follow && x !== null) {
      const view = this.#viewAt(x, y);
      const [dx, dy] = [x - view.left - view.width / 2, view.top + BODY_HEIGHT * view.height - y];
      const scale = this.#scale(view);
      const change = 1 / (scale * this.zoom) - 1 / (scale * zoom);
      this.free = [this.free[0] + dx * change, this.free[1] + dy * change];
    }
    this.zoom = zoom;
    this.#show();
  }

  resetView() {
    this.zoom = 1;
    this.setFollow(true);
  }

  setMode(mode) {
    this.mode = mode;
    this.#layOut();
    this.#show();
  }

  showCharts(shown) {
    this.parts.charts.hidden = !shown;
    if (shown && !this.charts) {
      this.charts = new Charts(this.parts.charts, this.replays, { onSeek: (time) => this.seek(time) });
    }
    if (this.views) this.#show();
  }

  showShortcuts() {
    if (!this.parts.shortcuts.open) this.parts.shortcuts.showModal();
  }

  // --- elements ---

  #build(element) {
    this.root = make("div", { class: "player", role: "group", tabindex: "0" });
    this.root.setAttribute("aria-label", this.options.title || this.replays.map((r) => r.header.title).join(" and "));
    this.canvas = make("canvas", { class: "player-canvas", role: "img" });
    this.canvas.setAttribute("aria-label", this.replays.map(described).join("; "));
    const stage = make("div", { class: "player-stage" }, this.canvas);
    this.layer = document.createElement("canvas"); // a ghost, before it is laid over the rest
    const two = this.replays.length > 1;
    const p = (this.parts = {
      play: this.#button("Play", "play", () => this.toggle()),
      slider: make("input", { type: "range", min: "0", max: String(this.steps), step: "1", value: "0" }),
      clock: make("output", { class: "player-clock", "aria-hidden": "true" }),
      speed: make("select", { "aria-label": "Speed", title: "Speed (< >)" }),
      follow: this.#button("Follow", null, () => this.setFollow(!this.follow), "F"),
      mode: two && this.#button("Ghosts", null, () => this.setMode(this.mode === "ghost" ? "side" : "ghost"), "G"),
      chart: this.#button("Charts", null, () => this.showCharts(this.parts.charts.hidden), "C"),
      charts: make("div", { class: "player-charts" }),
      shortcuts: make("dialog", { class: "player-shortcuts", "aria-label": "Keyboard shortcuts" }),
    });
    p.play.classList.add("player-play");
    p.slider.className = "player-slider";
    p.slider.setAttribute("aria-label", "Time");
    for (const speed of SPEEDS) {
      const text = speed < 1 ? `1/${1 / speed}×` : `${speed}×`;
      p.speed.append(make("option", { value: String(speed) }, text));
    }
    p.speed.value = "1";
    const group = (...children) => make("div", { class: "player-group" }, ...children.filter(Boolean));
    const controls = make("div", { class: "player-controls", role: "toolbar", "aria-label": "Player" },
      group(
        this.#button("To the start", "start", () => this.seek(0), "Home"),
        this.#button("One step back", "back", () => this.stepBy(-1), "←"),
        p.play,
        this.#button("One step on", "on", () => this.stepBy(1), "→"),
        this.#button("To the end", "end", () => this.seek(this.duration), "End"),
      ),
      p.clock,
      group(
        p.speed,
        this.#button("Zoom out", "out", () => this.zoomBy(1 / 1.25), "−"),
        this.#button("Zoom in", "in", () => this.zoomBy(1.25), "+"),
        p.follow, p.mode, p.chart,
        this.#button("Keyboard shortcuts", null, () => this.showShortcuts(), "?", "?"),
      ),
    );
    this.#buildShortcuts();
    this.root.append(stage, p.slider, controls, p.charts, p.shortcuts);
    element.append(this.root);
  }

  #button(name, icon, action, key = "", text = name) {
    const button = make("button", { type: "button", title: key ? `${name} (${key})` : name, "aria-label": name });
    if (icon) button.append(drawing(ICONS[icon]));
    else button.append(text);
    button.addEventListener("click", action, { signal: this.#abort.signal });
    return button;
  }

  #buildShortcuts() {
    const rows = SHORTCUTS.map(([keys, text]) =>
      make("tr", {}, make("th", { scope: "row" }, make("kbd", {}, keys)), make("td", {}, text)));
    const close = this.#button("Close", null, () => this.parts.shortcuts.close());
    const mouse = "Drag to move a free camera; the wheel or two fingers zoom. Click or drag in the charts to go there.";
    this.parts.shortcuts.append(
      make("h2", {}, "Keyboard shortcuts"), make("table", {}, make("tbody", {}, ...rows)), make("p", {}, mouse), close);
  }

  // --- events ---

  #listen() {
    const options = { signal: this.#abort.signal };
    const { slider, speed } = this.parts;
    slider.addEventListener("input", () => this.seek(Number(slider.value) * this.dt), options);
    speed.addEventListener("change", () => this.setSpeed(Number(speed.value)), options);
    const keys = this.options.keyboard ? document : this.root;
    keys.addEventListener("keydown", (event) => this.#key(event), options);
    this.canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const lines = event.deltaMode === 1 ? 16 : 1;
      this.zoomBy(Math.exp(-Math.min(Math.max(event.deltaY * lines, -120), 120) * 0.002), ...this.#place(event));
    }, { ...options, passive: false });
    this.canvas.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      this.canvas.setPointerCapture(event.pointerId);
      this.#pointers.set(event.pointerId, this.#place(event));
    }, options);
    this.canvas.addEventListener("pointermove", (event) => this.#drag(event), options);
    for (const kind of ["pointerup", "pointercancel"]) {
      this.canvas.addEventListener(kind, (event) => this.#pointers.delete(event.pointerId), options);
    }
    this.resizing = new ResizeObserver(() => this.#resize());
    this.resizing.observe(this.canvas);
    this.theming = new MutationObserver(() => this.#retheme());
    this.theming.observe(document.documentElement, { attributes: true, attributeFilter: ["data-theme"] });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.#retheme(), options);
  }

  #key(event) {
    const { target } = event;
    if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented || !this.root.isConnected) return;
    const ours = target === this.parts.slider;
    if (!ours && target.closest?.("select, textarea, input, [contenteditable]")) return;
    const dialog = document.querySelector("dialog[open]");
    if (dialog && !dialog.contains(this.root)) return;
    if (event.key === " " && target.closest?.("button, summary, a")) return; // pressed, as everywhere
    const far = event.shiftKey ? 10 : 1;
    const actions = {
      " ": () => this.toggle(),
      ArrowLeft: () => this.stepBy(-far),
      ArrowRight: () => this.stepBy(far),
      Home: () => this.seek(0),
      End: () => this.seek(this.duration),
      "<": () => this.changeSpeed(-1),
      ",": () => this.changeSpeed(-1),
      ">": () => this.changeSpeed(1),
      ".": () => this.changeSpeed(1),
      "+": () => this.zoomBy(1.25),
      "=": () => this.zoomBy(1.25),
      "-": () => this.zoomBy(1 / 1.25),
      0: () => this.resetView(),
      f: () => this.setFollow(!this.follow),
      g: () => this.replays.length > 1 && this.setMode(this.mode === "ghost" ? "side" : "ghost"),
      c: () => this.showCharts(this.parts.charts.hidden),
      "?": () => this.showShortcuts(),
    };
    const action = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action) return;
    event.preventDefault();
    action();
  }

  #place(event) {
    const box = this.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  #drag(event) {
    const before = this.#pointers.get(event.pointerId);
    if (!before) return;
    const here = this.#place(event);
    if (this.#pointers.size === 2) {
      const [other] = [...this.#pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
      const gap = (place) => Math.max(Math.hypot(place[0] - other[0], place[1] - other[1]), 10);
      this.zoomBy(gap(here) / gap(before), (here[0] + other[0]) / 2, (here[1] + other[1]) / 2);
    } else if (!this.follow) {
      const { scale } = this.#viewAt(...here).camera;
      this.free = [this.free[0] - (here[0] - before[0]) / scale, this.free[1] + (here[1] - before[1]) / scale];
      this.#show();
    }
    this.#pointers.set(event.pointerId, here);
  }

  #retheme() {
    const chosen = document.documentElement.dataset.theme;
    const dark = chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
    this.palette = PALETTES[dark ? "dark" : "light"];
    const style = getComputedStyle(this.root);
    this.marks = ["--a", "--b"].map((name) => style.getPropertyValue(name).trim());
    this.charts?.redraw();
    if (this.views) this.#show();
  }

  #resize() {
    this.width = this.canvas.clientWidth;
    this.height = this.canvas.clientHeight;
    if (!this.width || !this.height) return;
    this.ratio = window.devicePixelRatio || 1;
    for (const canvas of [this.canvas, this.layer]) {
      canvas.width = Math.round(this.width * this.ratio);
      canvas.height = Math.round(this.height * this.ratio);
    }
    this.#layOut();
    this.#draw(); // at once: a resized canvas is empty
  }

  // --- frames ---

  /** Where on the canvas which replays are seen. */
  #layOut() {
    const { width, height } = this;
    if (!width) return;
    const all = this.replays.map((_, k) => k);
    if (this.replays.length === 1 || this.mode === "ghost") this.views = [{ left: 0, top: 0, width, height, shown: all }];
    else if (width >= 640) {
      this.views = all.map((k) => ({ left: (k * width) / 2, top: 0, width: width / 2, height, shown: [k] }));
    } else this.views = all.map((k) => ({ left: 0, top: (k * height) / 2, width, height: height / 2, shown: [k] }));
    for (const view of this.views) view.camera = this.#camera(view);
  }

  #viewAt(x, y) {
    return this.views.findLast((view) => x >= view.left && y >= view.top) ?? this.views[0];
  }

  #scale({ shown, width, height }) {
    return bodyScale(Math.max(...shown.map((k) => this.replays[k].header.extent)), width, height);
  }

  #rowAt(k) {
    return Math.min(this.time / this.replays[k].dt, this.replays[k].steps);
  }

  /** Follows smoothly; two bodies in one picture from further away, the first never out of sight. */
  #camera(view) {
    const { shown, width, height } = view;
    let scale = this.#scale(view);
    if (!this.follow) return new Camera(...this.free, scale * this.zoom, width, height);
    const [first, second] = shown.map((k) => {
      const { path, com } = this.replays[k];
      const [aim, body] = [path, com].map((rows) => centreAt(rows, this.#rowAt(k)));
      return [width, height].map((size, axis) => {
        const slack = (CAMERA_SLACK * size) / scale;
        return body[axis] + Math.min(Math.max(aim[axis] - body[axis], -slack), slack);
      });
    });
    let [x, y] = first;
    if (second) {
      const apart = Math.abs(second[0] - x) + 1.5 * this.replays[shown[0]].header.extent;
      scale = Math.min(Math.max((0.9 * width) / apart, FAR * scale), scale);
      const most = (0.3 * width) / scale;
      x += Math.min(Math.max((second[0] - x) / 2, -most), most);
    }
    return new Camera(x, y, scale * this.zoom, width, height);
  }

  #show() {
    if (!this.#request) this.#request = requestAnimationFrame((now) => this.#frame(now));
  }

  #frame(now) {
    this.#request = 0;
    if (this.playing) {
      const passed = this.#before === null ? 0 : Math.min((now - this.#before) / 1000, 0.25);
      this.#before = now;
      this.#count(now);
      this.time += passed * this.speed;
      if (this.time >= this.duration) {
        this.time = this.options.loop ? this.time % this.duration : this.duration;
        this.playing = this.options.loop;
      }
    }
    const began = performance.now();
    this.#draw();
    this.stats.drawing += 0.1 * (performance.now() - began - this.stats.drawing);
    if (this.playing) this.#show();
  }

  #count(now) {
    this.#times.push(now);
    if (this.#times.length > 121) this.#times.shift();
    const seconds = (now - this.#times[0]) / 1000;
    if (seconds > 0) this.stats.fps = (this.#times.length - 1) / seconds;
  }

  #draw() {
    if (!this.views) return;
    const context = this.canvas.getContext("2d", { alpha: false });
    for (const view of this.views) {
      view.camera = this.#camera(view);
      context.setTransform(this.ratio, 0, 0, this.ratio, this.ratio * view.left, this.ratio * view.top);
      context.save();
      context.beginPath();
      context.rect(0, 0, view.width, view.height);
      context.clip();
      this.#drawView(context, view);
      context.restore();
    }
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    context.fillStyle = this.palette.faint;
    for (const { left, top } of this.views.slice(1)) {
      if (left) context.fillRect(left - 1, 0, 2, this.height);
      else context.fillRect(0, top - 1, this.width, 2);
    }
    if (this.charts && !this.parts.charts.hidden) this.charts.draw(this.time);
    this.#tell();
    this.stats.frames += 1;
    this.stats.firstFrame ??= performance.now() - this.created;
  }

  #drawView(context, view) {
    const { camera, shown } = view;
    const text = Math.min(Math.max(Math.min(view.width / 1280, view.height / 720), 0.76), 1.5);
    this.worlds[shown[0]].draw(context, camera, this.palette, { text });
    if (shown.length > 1) this.#drawGhost(context, view, shown[1]);
    drawBody(context, this.replays[shown[0]], this.#rowAt(shown[0]), camera, this.palette);
    const panel = this.#drawReadings(context, view, text);
    this.#drawLegend(context, view, text, panel);
    if (shown.length > 1) this.#drawPointer(context, view, shown[1], text);
  }

  #drawGhost(context, view, k) {
    const ghost = this.layer.getContext("2d");
    ghost.setTransform(1, 0, 0, 1, 0, 0);
    ghost.clearRect(0, 0, this.layer.width, this.layer.height);
    ghost.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    drawBody(ghost, this.replays[k], this.#rowAt(k), view.camera, this.palette);
    context.globalAlpha = GHOST;
    context.drawImage(this.layer, 0, 0, this.width, this.height);
    context.globalAlpha = 1;
  }

  /** At the edge: where a body that is out of sight is. */
  #drawPointer(context, { camera, width, shown }, k, text) {
    const [x] = centreAt(this.replays[k].com, this.#rowAt(k));
    const [own] = centreAt(this.replays[shown[0]].com, this.#rowAt(shown[0]));
    const right = camera.px(x) > width;
    if (!right && camera.px(x) >= 0) return;
    context.font = `600 ${14 * text}px system-ui, sans-serif`;
    context.textAlign = right ? "right" : "left";
    context.textBaseline = "middle";
    const words = `${"AB"[k]} ${number(Math.abs(x - own), 1)} m`;
    const wide = context.measureText(words).width + 24 * text;
    const y = camera.height * 0.5;
    this.#drawPanel(context, right ? width - wide - 6 : 6, y - 14 * text, wide, 28 * text);
    context.fillStyle = this.marks[k];
    context.fillText(right ? `${words} ▸` : `◂ ${words}`, right ? width - 10 : 10, y);
  }

  #drawPanel(context, left, top, width, height) {
    context.fillStyle = this.palette.panel;
    context.beginPath();
    context.roundRect(left, top, width, height, 8);
    context.fill();
  }

  /** Title, time, distance and speed in the top left corner; returns the panel's right edge. */
  #drawReadings(context, { width, shown }, text) {
    const font = (weight, size) => `${weight} ${size * text}px system-ui, sans-serif`;
    const [margin, line, pad, cell] = [Math.round(10 * text), 22 * text, 13 * text, 84 * text];
    const both = this.replays.length > 1;
    const titles = shown.map((k) => (both ? `${"AB"[k]}  ` : "") + titleOf(this.replays[k].header));
    context.font = font(600, 15);
    const most = width - 2 * margin - 2 * pad;
    const wide = Math.max(...titles.map((title) => context.measureText(title).width), 82 * text + cell * shown.length);
    const panel = Math.min(wide, most) + 2 * pad;
    this.#drawPanel(context, margin, margin, panel, (titles.length + 3) * line + 14 * text);
    context.textBaseline = "top";
    context.textAlign = "left";
    let y = margin + 9 * text;
    titles.forEach((title, n) => {
      context.fillStyle = both ? this.marks[shown[n]] : this.palette.text;
      context.fillText(fitted(context, title, most), margin + pad, y);
      y += line;
    });
    const rows = shown.map((k) => {
      const { com, speed, steps } = this.replays[k];
      const row = this.#rowAt(k);
      return [
        `${number(Math.min(this.time, this.replays[k].duration), 2)} s`,
        `${number(centreAt(com, row)[0] - com[0], 1)} m`,
        `${number(speed[Math.min(Math.round(row), steps)], 2)} m/s`,
      ];
    });
    ["time", "distance", "speed"].forEach((name, n) => {
      context.textAlign = "left";
      context.font = font(400, 15);
      context.fillStyle = this.palette.faint;
      context.fillText(name, margin + pad, y);
      context.textAlign = "right";
      context.fillStyle = this.palette.text;
      rows.forEach((values, k) => context.fillText(values[n], margin + pad + 82 * text + cell * (k + 1) - 6 * text, y));
      y += line;
    });
    return margin + panel;
  }

  /** Colour bars with a triangle at each present value: top right, or in the ground where there is no room. */
  #drawLegend(context, view, text, panel) {
    const { width, height, shown } = view;
    const replay = this.replays[shown[0]];
    const { header } = replay;
    const step = Math.floor(this.#rowAt(shown[0]) + 1e-6);
    const bars = [];
    if (replay.chambers) {
      const values = header.chambers.map((_, c) => replay.pressure[step * replay.chambers + c]);
      const ends = header.pressure_range.map((p) => number(p / 1000, p < 1e5 ? 1 : 0));
      bars.push({ name: "gas pressure [kPa]", map: PRESSURE_MAP, range: header.pressure_range, values, ends });
    }
    if (replay.springs) {
      const values = header.springs.map((_, j) => replay.strain(step, j));
      const ends = header.strain_range.map((s) => `${s > 1 ? "+" : ""}${number(100 * (s - 1), 0)}%`);
      bars.push({ name: "spring strain", map: STRAIN_MAP, range: header.strain_range, values, ends });
    }
    const margin = Math.round(10 * text);
    const above = panel + 210 * text + 2 * margin <= width;
    if (!above && height < 300) return; // no room beside the body
    const wide = above ? 210 * text : Math.min(210 * text, (width - 3 * margin) / 2);
    const tall = 54 * text;
    bars.forEach((bar, n) => {
      const left = above ? width - wide - margin : width / 2 + (n - bars.length / 2) * (wide + margin) + margin / 2;
      const top = above ? margin + n * (tall + margin / 2) : height - tall - margin;
      this.#drawBar(context, bar, left, top, wide, tall, text);
    });
  }

  #drawBar(context, { name, map, range, values, ends }, left, top, width, height, text) {
    this.#drawPanel(context, left, top, width, height);
    context.font = `${12.5 * text}px system-ui, sans-serif`;
    context.textBaseline = "top";
    context.textAlign = "center";
    context.fillStyle = this.palette.text;
    context.fillText(name, left + width / 2, top + 5 * text);
    const [x, y, long, thick] = [left + 12 * text, top + 22 * text, width - 24 * text, 9 * text];
    const colours = context.createLinearGradient(x, 0, x + long, 0);
    for (let n = 0; n <= 16; n++) colours.addColorStop(n / 16, shade(map, n, [0, 16]));
    context.fillStyle = colours;
    context.fillRect(x, y, long, thick);
    context.strokeStyle = this.palette.faint;
    context.lineWidth = 1;
    context.strokeRect(x - 0.5, y - 0.5, long + 1, thick + 1);
    context.fillStyle = this.palette.faint;
    ends.forEach((end, side) => {
      context.textAlign = side ? "right" : "left";
      context.fillText(end, x + side * long, y + thick + 6 * text);
    });
    context.fillStyle = this.palette.text;
    context.beginPath();
    for (const value of values) {
      const at = x + long * Math.min(Math.max((value - range[0]) / (range[1] - range[0]), 0), 1);
      context.moveTo(at, y + thick + 1);
      context.lineTo(at - 4 * text, y + thick + 1 + 5 * text);
      context.lineTo(at + 4 * text, y + thick + 1 + 5 * text);
      context.closePath();
    }
    context.fill();
  }

  /** Brings the controls up to date; only what changed is touched. */
  #tell() {
    const { play, slider, clock, follow, mode, chart, charts } = this.parts;
    const step = String(this.step);
    if (slider.value !== step) slider.value = step;
    slider.style.setProperty("--share", String(this.time / Math.max(this.duration, 1e-9)));
    clock.value = `${number(this.time, 2)} / ${number(this.duration, 1)} s`;
    const words = `${number(this.time, 1)} of ${number(this.duration, 1)} seconds`;
    if (!this.playing && slider.getAttribute("aria-valuetext") !== words) slider.setAttribute("aria-valuetext", words);
    const name = this.playing ? "Pause" : "Play";
    if (play.getAttribute("aria-label") !== name) {
      play.setAttribute("aria-label", name);
      play.title = `${name} (Space)`;
      play.replaceChildren(drawing(ICONS[this.playing ? "pause" : "play"]));
    }
    for (const [button, on] of [[follow, this.follow], [mode, this.mode === "ghost"], [chart, !charts.hidden]]) {
      if (button && button.getAttribute("aria-pressed") !== String(on)) button.setAttribute("aria-pressed", String(on));
    }
  }
}

/** "hilly, large, pressure, seed 0: 3.65 m/s" */
export function titleOf({ title, fitness, unit }) {
  return fitness === null ? title : `${title}: ${number(fitness, 2)}${unit}`;
}

function described({ header, masses, duration }) {
  return `A soft agent of ${masses} masses for ${number(duration, 1)} s: ${titleOf(header)}`;
}

/** The text, cut where it is wider than `most` [px]. */
function fitted(context, text, most) {
  if (context.measureText(text).width <= most) return text;
  let cut = text;
  while (cut && context.measureText(`${cut}…`).width > most) cut = cut.slice(0, -1);
  return `${cut}…`;
}

function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

function drawing(path) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("viewBox", "0 0 24 24");
  svg.setAttribute("aria-hidden", "true");
  const shape = document.createElementNS("http://www.w3.org/2000/svg", "path");
  shape.setAttribute("d", path);
  svg.append(shape);
  return svg;
}
