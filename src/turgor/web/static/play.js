// The playground: an agent driven by hand. start(element, socketUrl) builds it into `element` and connects.

import { Motion, View, gradient } from "./play-view.js";

const TASKS = { hilly: "Hills", flat: "Flat", escape: "Cage" };
const BODIES = { small: "Small", medium: "Medium", large: "Large" };
const SLIDERS = {
  pressure: { label: "Pressure", min: 0, max: 1, step: 0.01, value: 0.82 },
  amplitude: { label: "Strength", min: 0, max: 1, step: 0.01, value: 0, text: (v) => `${Math.round(100 * v)} %` },
  pace: { label: "Frequency", min: 0.1, max: 4, step: 0.1, value: 1.2, text: (v) => `${v.toFixed(1)} Hz` },
  length: { label: "Waves around the ring", min: 0, max: 5, step: 0.5, value: 1, text: (v) => v.toFixed(1) },
  gravity: { label: "Gravity", min: 0, max: 25, step: 0.5, value: 10, text: (v) => `${v.toFixed(1)} m/s²` },
  frequency: { label: "Spring frequency", min: 1, max: 20, step: 0.5, value: 8, text: (v) => `${v.toFixed(1)} Hz` },
};
const NOTICE = 6000; // [ms], how long a notice stays while frames come
const KEYS = [
  ["↑ ↓", "more or less pressure"],
  ["→", "a stronger clockwise wave"],
  ["←", "a stronger counter-clockwise wave"],
  ["Space", "pause"],
  ["R", "back to the start"],
  ["drag", "pull the nearest mass"],
];

/** Builds the playground into `element`; returns {stop()}, which leaves nothing running. */
export function start(element, socketUrl) {
  const root = node("div", { class: "play" }, page());
  element.replaceChildren(root);
  const find = (name) => root.querySelector(`[data-play="${name}"]`);
  const canvas = find("canvas"), view = new View(canvas), ended = new AbortController(), { signal } = ended;
  const choice = { task: "hilly", body: "small", seed: 0 };
  let socket = null, motion = null, frame = null, hand = null, direction = -1;
  let paused = false, changed = false, seen = 0, said = 0, came = 0, noticed = 0, before = performance.now(), hint = true;

  // --- talking to the server ---

  function connect() {
    find("closed").hidden = true;
    const mine = (socket = new WebSocket(new URL(socketUrl, location.href.replace(/^http/, "ws"))));
    mine.binaryType = "arraybuffer";
    mine.onopen = begin;
    mine.onmessage = ({ data }) => (typeof data === "string" ? hear(JSON.parse(data)) : see(data));
    mine.onclose = ({ reason }) => {
      if (mine !== socket || signal.aborted) return;
      letGo();
      find("why").textContent = reason ? `The connection was closed: ${reason}.` : "The connection was closed.";
      find("closed").hidden = false;
    };
  }

  function say(message) {
    if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
  }

  function begin() {
    letGo();
    say({ type: "start", ...choice, gravity: value("gravity"), frequency: value("frequency") });
    sayControl();
    if (paused) say({ type: "pause", on: true });
  }

  function sayControl() {
    changed = false;
    const wave = { amplitude: value("amplitude"), frequency: value("pace"), length: value("length"), direction };
    say({ type: "control", pressure: value("pressure"), wave });
  }

  function hear(message) {
    if (message.type === "scene") {
      motion = new Motion(message);
      frame = null;
      view.show(message);
      showValues();
    } else if (message.type === "error") {
      notice(message.message);
    } else if (message.type === "status") {
      notice(message.message || (message.rate < 60 ? `many visitors: ${message.rate} frames a second` : ""));
    }
  }

  function see(buffer) {
    motion?.add(buffer);
    came = performance.now();
    if (came - seen > 200) {
      seen = came;
      say({ type: "seen" });
    }
  }

  // --- controls ---

  const value = (name) => Number(find(name).value);

  function set(name, number) {
    const input = find(name);
    input.value = Math.min(Math.max(number, input.min), input.max);
    showValues();
    changed = true;
  }

  function showValues() {
    for (const [name, { text }] of Object.entries(SLIDERS)) {
      const input = find(name), share = (input.value - input.min) / (input.max - input.min);
      input.style.setProperty("--share", `${100 * share}%`);
      if (text) show(`${name}-value`, text(Number(input.value)));
    }
    const [low, high] = motion?.scene.pressure_range ?? [0, 0], target = low + value("pressure") * (high - low);
    show("pressure-value", `${(target / 1000).toFixed(1)} kPa`);
    for (const button of root.querySelectorAll("[data-choice]")) {
      const { choice: name, value: option } = button.dataset;
      const chosen = name === "direction" ? Number(option) === direction : choice[name] === option;
      button.setAttribute("aria-pressed", chosen);
    }
    find("terrain").disabled = choice.task !== "hilly";
    find("pause").textContent = paused ? "Resume" : "Pause";
    find("pause").setAttribute("aria-pressed", paused);
  }

  function show(name, text) {
    const place = find(name);
    if (place.textContent !== text) place.textContent = text;
  }

  function notice(text) {
    noticed = performance.now();
    show("notice", text);
    find("notice").hidden = !text;
  }

  function pause(on) {
    paused = on;
    say({ type: "pause", on });
    showValues();
  }

  function reset() {
    letGo();
    say({ type: "reset" });
  }

  /** Right is clockwise: the wave against it gets weaker first. */
  function steer(turn) {
    const strength = value("amplitude") * (direction === turn ? 1 : -1) + 0.1;
    if (strength > 0.001) direction = turn;
    set("amplitude", Math.abs(strength) < 0.001 ? 0 : Math.abs(strength));
  }

  root.addEventListener("submit", (event) => event.preventDefault(), { signal });
  root.addEventListener("input", ({ target }) => {
    if (target.dataset.world) showValues();
    else if (target.type === "range") set(target.dataset.play, Number(target.value));
  }, { signal });
  root.addEventListener("change", ({ target }) => target.dataset.world && begin(), { signal });
  root.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    const { choice: name, value: option, play } = button.dataset;
    if (name === "direction") {
      direction = Number(option);
      changed = true;
    } else if (name) {
      choice[name] = option;
      begin();
    }
    if (play === "terrain") {
      choice.seed = Math.floor(Math.random() * 1e6);
      begin();
    }
    if (play === "pause") pause(!paused);
    if (play === "reset") reset();
    if (play === "reconnect") connect();
    showValues();
    if (event.detail > 0) canvas.focus({ preventScroll: true }); // so that the keys drive the agent, not the button
  }, { signal });

  const ACTIONS = {
    ArrowUp: () => set("pressure", value("pressure") + 0.04),
    ArrowDown: () => set("pressure", value("pressure") - 0.04),
    ArrowRight: () => steer(-1),
    ArrowLeft: () => steer(1),
    " ": (event) => event.repeat || pause(!paused),
    r: reset,
    R: reset,
  };
  window.addEventListener("keydown", (event) => {
    const at = event.target.closest?.("input, select, textarea, button, summary, a, [contenteditable]");
    const own = at && (event.key === " " || (at.matches("input") && event.key.startsWith("Arrow")));
    const typed = at && (!root.contains(at) || at.matches("select, textarea, [contenteditable]"));
    if (!ACTIONS[event.key] || own || typed || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    hint = false;
    ACTIONS[event.key](event);
  }, { signal });

  // --- dragging ---

  const place = ({ clientX, clientY }) => {
    const box = canvas.getBoundingClientRect();
    return [clientX - box.left, clientY - box.top];
  };
  const grabbed = (event) => (frame ? view.nearest(frame.position, ...place(event)) : null);

  // a finger on the agent drags it, one beside it scrolls the page
  canvas.addEventListener("touchstart", (event) => {
    if (grabbed(event.touches[0]) !== null) event.preventDefault();
  }, { signal, passive: false });
  canvas.addEventListener("pointerdown", (event) => {
    const mass = event.button === 0 && !hand ? grabbed(event) : null;
    if (mass === null) return;
    hand = { mass, pointer: place(event), id: event.pointerId };
    canvas.setPointerCapture(event.pointerId);
    canvas.focus({ preventScroll: true });
    view.held = true;
    hint = false;
    said = 0;
  }, { signal });
  canvas.addEventListener("pointermove", (event) => {
    if (hand?.id === event.pointerId) hand.pointer = place(event);
    else if (!hand) canvas.style.cursor = grabbed(event) === null ? "" : "grab";
  }, { signal });
  for (const kind of ["pointerup", "pointercancel", "lostpointercapture"])
    canvas.addEventListener(kind, (event) => hand?.id === event.pointerId && letGo(), { signal });

  function letGo() {
    if (!hand) return;
    hand = null;
    view.held = false;
    say({ type: "drop" });
  }

  function sayHand(now) {
    if (!hand || now - said < 30) return;
    said = now;
    const [x, y] = view.metres(...hand.pointer);
    say({ type: "drag", mass: hand.mass, x, y });
  }

  // --- showing ---

  function draw(now) {
    if (signal.aborted) return;
    const elapsed = Math.min((now - before) / 1000, 0.1);
    before = now;
    frame = motion?.advance(paused ? 0 : elapsed) ?? frame;
    if (changed) sayControl();
    if (frame && motion) {
      sayHand(now);
      view.draw(motion, frame, elapsed, hand);
      readings();
    }
    if (came > noticed + NOTICE) find("notice").hidden = true;
    find("hint").hidden = !hint || !frame;
    requestAnimationFrame(draw);
  }

  function readings() {
    const minus = (text) => (Number.parseFloat(text) === 0 ? text.replace("-", "") : text.replace("-", "−"));
    show("read-pressure", `${(frame.pressure / 1000).toFixed(1)} kPa`);
    show("read-area", frame.area.toFixed(2));
    show("read-speed", minus(`${motion.speed.toFixed(2)} m/s`));
    show("read-distance", minus(`${motion.distance.toFixed(1)} m`));
    show("read-time", `${frame.t.toFixed(1)} s`);
    show("read-out", motion.solved === null ? "" : `out after ${motion.solved.toFixed(1)} s`);
  }

  const resized = new ResizeObserver(() => {
    view.fit();
    if (frame && motion) view.draw(motion, frame, 0, hand);
  });
  resized.observe(canvas);
  const match = () => view.match(getComputedStyle(root).backgroundColor);
  const themed = new MutationObserver(match);
  themed.observe(document.documentElement, { attributes: true });
  themed.observe(document.body, { attributes: true });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", match, { signal });
  // nobody watches a hidden page: the server need not work for it
  document.addEventListener("visibilitychange", () => paused || say({ type: "pause", on: document.hidden }), { signal });

  // here rather than in the markup, which a server's content security policy may not allow
  root.style.setProperty("--pressures", gradient("pressure"));
  find("strain").style.background = gradient("strain");
  match();
  showValues();
  connect();
  requestAnimationFrame(draw);
  return {
    stop() {
      ended.abort();
      resized.disconnect();
      themed.disconnect();
      socket?.close();
      root.remove();
    },
  };
}

// --- the page ---

function node(tag, attributes = {}, inner = "") {
  const out = document.createElement(tag);
  for (const [name, text] of Object.entries(attributes)) out.setAttribute(name, text);
  out.innerHTML = inner; // our own text alone
  return out;
}

function slider(name, world = false) {
  const { label, min, max, step, value } = SLIDERS[name];
  return `<label class="play-slider"><span>${label}</span><output data-play="${name}-value"></output>
    <input type="range" data-play="${name}" ${world ? "data-world=1" : ""} aria-label="${label}"
      min="${min}" max="${max}" step="${step}" value="${value}" autocomplete="off"></label>`;
}

function choices(name, label, options) {
  const buttons = Object.entries(options).map(
    ([value, text]) => `<button type="button" data-choice="${name}" data-value="${value}">${text}</button>`,
  );
  return `<div class="play-choices" role="group" aria-label="${label}">${buttons.join("")}</div>`;
}

function page() {
  const reading = ([name, label]) => `<div><dt>${label}</dt><dd data-play="read-${name}">–</dd></div>`;
  const shown = [["pressure", "pressure"], ["area", "area ratio"], ["speed", "speed"], ["distance", "distance"], ["time", "time"]];
  return `
  <div class="play-stage">
    <canvas data-play="canvas" tabindex="0" role="img"
      aria-label="The agent, seen from the side. Drag a mass with the pointer; arrow keys drive it."></canvas>
    <dl class="play-readings">${shown.map(reading).join("")}<div class="play-out"><dd data-play="read-out"></dd></div></dl>
    <div class="play-legend" aria-hidden="true"><i data-play="strain"></i>
      <span>springs: short</span><span>long</span></div>
    <p class="play-hint" data-play="hint" hidden>drag a mass, or press <kbd>→</kbd></p>
    <p class="play-notice" data-play="notice" role="status" hidden></p>
    <div class="play-closed" data-play="closed" role="alert" hidden>
      <p data-play="why"></p><button type="button" class="play-main" data-play="reconnect">Reconnect</button></div>
  </div>
  <form class="play-controls" aria-label="Controls">
    <div class="play-row">
      <button type="button" class="play-main" data-play="pause">Pause</button>
      <button type="button" data-play="reset">Reset</button>
    </div>
    <fieldset><legend>Gas</legend><div class="play-gas">${slider("pressure")}</div></fieldset>
    <fieldset><legend>Wave of contraction</legend>
      ${slider("amplitude")}${slider("pace")}${slider("length")}
      ${choices("direction", "Direction of the wave", { 1: "↺ counter-clockwise", "-1": "↻ clockwise" })}</fieldset>
    <fieldset><legend>World <small>a change starts anew</small></legend>
      ${choices("task", "Terrain", TASKS)}
      <button type="button" data-play="terrain">New hills</button>
      ${choices("body", "Body", BODIES)}
      ${slider("gravity", true)}${slider("frequency", true)}</fieldset>
    <details open><summary>Keys</summary><dl class="play-keys">
      ${KEYS.map(([key, what]) => `<div><dt><kbd>${key}</kbd></dt><dd>${what}</dd></div>`).join("")}</dl></details>
  </form>`;
}
