// Draws the playground: a scene, and one agent between its last two frames. Knows neither sockets nor controls.

const PRESSURE_MAP = [[247, 252, 214], [201, 233, 160], [120, 198, 121], [49, 145, 96], [0, 88, 66]];
const STRAIN_MAP = [[5, 48, 140], [67, 147, 210], [247, 247, 247], [236, 112, 84], [178, 10, 35]];
const INK = "rgb(28 34 44)", MASS = "rgb(116 127 144)", MASS_EDGE = "rgb(40 47 60)";
const TOUCHING = "rgb(34 39 50)", TOUCHING_EDGE = "rgb(255 176 0)";
const LIGHT = {
  sky: ["rgb(196 217 236)", "rgb(246 249 251)"], grid: "rgb(120 145 170 / 0.22)", solid: "rgb(66 72 84)",
  edge: "rgb(138 149 165)", tick: "rgb(146 156 171)", text: "rgb(214 220 229)", trail: "58 66 82", hand: "rgb(28 34 44)",
};
const DARK = {
  sky: ["rgb(11 16 25)", "rgb(29 40 55)"], grid: "rgb(150 175 205 / 0.1)", solid: "rgb(56 64 77)",
  edge: "rgb(122 136 156)", tick: "rgb(124 137 156)", text: "rgb(190 201 216)", trail: "205 218 235", hand: "rgb(236 242 250)",
};
const SURFACE = 0.15, FAR = 1000; // [m]
const TRAIL = 8, MEMORY = 9; // [s]
const BODY_SHARE = 0.36, BODY_HEIGHT = 0.6; // of the canvas: the body's size, and where its centre stands
const SMOOTHING = [0.35, 0.6], SLACK = 0.22; // [s]; of the canvas

export function shade(colours, share) {
  const place = Math.min(Math.max(share, 0), 1) * (colours.length - 1);
  const k = Math.min(Math.floor(place), colours.length - 2);
  return `rgb(${colours[k].map((a, i) => Math.round(a + (place - k) * (colours[k + 1][i] - a))).join(" ")})`;
}

export const pressureColour = (share) => shade(PRESSURE_MAP, share);
export const gradient = (map) =>
  `linear-gradient(90deg, ${(map === "strain" ? STRAIN_MAP : PRESSURE_MAP).map((c) => `rgb(${c.join(" ")})`).join(", ")})`;

/** The frames of one agent, and where it is between them. */
export class Motion {
  constructor(scene) {
    this.scene = scene;
    this.total = scene.mass.reduce((sum, m) => sum + m, 0);
    this.clear();
  }

  clear() {
    this.frames = [];
    this.path = []; // [t, x, y] of the centre of mass
    this.shown = 0;
    this.start = null;
    this.solved = null; // [s], when it had left the cage
  }

  /** Takes a binary frame: float32 t, pressure, area ratio, x, y ...; uint8 touch ... */
  add(buffer) {
    const n = this.scene.masses;
    const numbers = new Float32Array(buffer, 0, 3 + 2 * n), touch = new Uint8Array(buffer, 4 * (3 + 2 * n), n);
    const last = this.frames.at(-1);
    if (last && numbers[0] < last.t) this.clear();
    const [t, pressure, area] = numbers, position = numbers.subarray(3);
    if (!this.frames.length) this.shown = t;
    this.frames.push({ t, pressure, area, position, touch });
    if (this.frames.length > 8) this.frames.shift();
    const com = this.centre(position);
    this.start ??= com;
    this.path.push([t, ...com]);
    while (this.path[0][0] < t - MEMORY) this.path.shift();
    const { end, side } = this.scene;
    if (end !== null && this.solved === null && side.every((s, i) => Math.abs(position[2 * i]) - 0.71 * s > end)) this.solved = t;
  }

  centre(position) {
    let x = 0, y = 0;
    this.scene.mass.forEach((m, i) => ((x += m * position[2 * i]), (y += m * position[2 * i + 1])));
    return [x / this.total, y / this.total];
  }

  /** What is to be seen `elapsed` seconds after the last call: a frame, a little behind the newest. */
  advance(elapsed) {
    const frames = this.frames;
    if (!frames.length) return null;
    const newest = frames.at(-1).t, spacing = frames.length > 1 ? (newest - frames[0].t) / (frames.length - 1) : 0;
    const behind = newest - 1.4 * spacing - (this.shown + elapsed);
    this.shown = Math.min(this.shown + elapsed + (Math.abs(behind) > 0.3 ? behind : 0.12 * behind), newest);
    let k = frames.length - 1;
    while (k > 0 && frames[k - 1].t >= this.shown) k--;
    if (k === 0) return { ...frames[0], com: this.centre(frames[0].position) };
    const [a, b] = [frames[k - 1], frames[k]], share = Math.min((this.shown - a.t) / (b.t - a.t), 1);
    const position = a.position.map((v, i) => v + share * (b.position[i] - v));
    return { ...b, t: this.shown, position, com: this.centre(position) };
  }

  /** Speed in x over the last second [m/s]. */
  get speed() {
    const last = this.path.at(-1), first = this.path.find(([t]) => t >= last[0] - 1.0001);
    return last[0] > first[0] ? (last[1] - first[1]) / (last[0] - first[0]) : 0;
  }

  get distance() {
    return this.path.length ? this.path.at(-1)[1] - this.start[0] : 0;
  }
}

/** A canvas that follows the agent. */
export class View {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.colours = LIGHT;
    this.centre = null; // [m], where the camera looks
    this.held = false; // whether it stands still
    this.scale = 20; // [px/m]
    this.fit();
  }

  fit() {
    const { clientWidth: width, clientHeight: height } = this.canvas, ratio = window.devicePixelRatio || 1;
    this.size = [Math.max(width, 1), Math.max(height, 1)];
    this.canvas.width = Math.round(this.size[0] * ratio);
    this.canvas.height = Math.round(this.size[1] * ratio);
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
  }

  /** Light or dark, by how bright the page behind is. */
  match(background) {
    const [r, g, b] = (background.match(/[\d.]+/g) ?? [255, 255, 255]).map(Number);
    this.colours = 0.3 * r + 0.59 * g + 0.11 * b < 128 ? DARK : LIGHT;
  }

  show(scene) {
    this.scene = scene;
    this.centre = null;
    const { segments, depth } = scene.scene;
    this.ground = segments.filter((_, k) => depth[k] > 0).map(([a, b, c, d]) => (a < c ? [a, b, c, d] : [c, d, a, b]));
    this.ground.sort((one, two) => one[0] - two[0]);
    this.walls = segments.filter((_, k) => depth[k] === 0);
    this.blocks = solids(this.walls);
  }

  pixel(x, y) {
    return [this.size[0] / 2 + (x - this.centre[0]) * this.scale, this.size[1] * BODY_HEIGHT - (y - this.centre[1]) * this.scale];
  }

  metres(px, py) {
    return [this.centre[0] + (px - this.size[0] / 2) / this.scale, this.centre[1] - (py - this.size[1] * BODY_HEIGHT) / this.scale];
  }

  look(com, elapsed) {
    const least = Math.min(this.size[0] * 1.15, this.size[1]);
    this.scale = (BODY_SHARE * least) / Math.max(2 * this.scene.radius + 1, 3);
    this.centre ??= [...com];
    for (const k of this.held ? [] : [0, 1]) {
      const slack = (SLACK * this.size[k]) / this.scale;
      const moved = this.centre[k] + (com[k] - this.centre[k]) * (1 - Math.exp(-elapsed / SMOOTHING[k]));
      this.centre[k] = Math.min(Math.max(moved, com[k] - slack), com[k] + slack);
    }
  }

  draw(motion, frame, elapsed, hand) {
    const c = this.context, [width, height] = this.size;
    this.look(frame.com, elapsed);
    const sky = c.createLinearGradient(0, 0, 0, height);
    this.colours.sky.forEach((colour, k) => sky.addColorStop(k, colour));
    c.fillStyle = sky;
    c.fillRect(0, 0, width, height);
    this.drawGrid();
    const seen = this.drawGround();
    this.drawWalls();
    this.drawRuler(seen);
    this.drawTrail(motion, frame);
    this.drawBody(frame);
    if (hand) this.drawHand(frame, hand);
  }

  /** Multiples of the spacing of the marks in view [m]. */
  marks(part) {
    const least = 64 / this.scale, power = 10 ** Math.floor(Math.log10(least));
    const spacing = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= least) / part;
    const [left] = this.metres(0, 0), [right] = this.metres(this.size[0], 0);
    const first = Math.ceil(left / spacing);
    return Array.from({ length: Math.max(Math.floor(right / spacing) - first + 1, 0) }, (_, k) => (first + k) * spacing);
  }

  drawGrid() {
    const c = this.context;
    c.strokeStyle = this.colours.grid;
    c.lineWidth = 1;
    c.beginPath();
    for (const x of this.marks(1)) {
      const [px] = this.pixel(x, 0);
      c.moveTo(px, 0);
      c.lineTo(px, this.size[1]);
    }
    c.stroke();
  }

  drawGround() {
    const c = this.context, bottom = this.size[1] + 10, thick = SURFACE * this.scale;
    const [left] = this.metres(-20, 0), [right] = this.metres(this.size[0] + 20, 0);
    const seen = this.ground.filter(([a, , b]) => a <= right && b >= left);
    if (!seen.length) return seen;
    const line = [seen[0].slice(0, 2), ...seen.map((s) => s.slice(2))].map(([x, y]) => this.pixel(x, y));
    c.beginPath();
    c.moveTo(line[0][0], bottom);
    for (const [x, y] of line) c.lineTo(x, y);
    c.lineTo(line.at(-1)[0], bottom);
    c.closePath();
    c.fillStyle = this.colours.solid;
    c.fill();
    c.save();
    c.clip();
    c.beginPath();
    line.forEach(([x, y]) => c.lineTo(x, y));
    c.lineWidth = 2 * Math.max(thick, 1.5); // its upper half is clipped off
    c.strokeStyle = this.colours.edge;
    c.stroke();
    c.restore();
    return seen;
  }

  drawRuler(ground) {
    const c = this.context, thick = SURFACE * this.scale;
    c.font = "12px system-ui, sans-serif";
    c.textAlign = "center";
    c.textBaseline = "top";
    c.strokeStyle = this.colours.tick;
    c.lineWidth = 1;
    const labelled = new Set(this.marks(1).map((x) => x.toFixed(3)));
    for (const x of this.marks(5)) {
      const s = ground.find(([a, , b]) => a <= x && x <= b);
      if (!s) continue;
      const [px, py] = this.pixel(x, s[1] + ((s[3] - s[1]) * (x - s[0])) / (s[2] - s[0]));
      const long = labelled.has(x.toFixed(3)), top = py + thick + 4;
      c.beginPath();
      c.moveTo(px, top);
      c.lineTo(px, top + (long ? 9 : 4));
      c.stroke();
      c.fillStyle = this.colours.text;
      if (long) c.fillText(`${Number(x.toFixed(3))} m`.replace("-", "−"), px, top + 13);
    }
  }

  drawWalls() {
    const c = this.context;
    c.fillStyle = c.strokeStyle = this.colours.solid;
    c.lineWidth = 1;
    for (const block of this.blocks) {
      this.fill(block);
      c.stroke(); // no seam between a wall and the ground
    }
    c.fillStyle = this.colours.edge;
    for (const wall of this.walls) this.fill(reachBack(this.aboveGround(wall), SURFACE));
  }

  /** The part of a vertical wall that stands out of the ground, other walls whole. */
  aboveGround([x1, y1, x2, y2]) {
    const under = x1 === x2 ? this.ground.filter(([a, , b]) => a <= x1 && x1 <= b) : [];
    if (!under.length) return [x1, y1, x2, y2];
    const top = Math.max(...under.map(([a, y, b, z]) => y + ((z - y) * (x1 - a)) / (b - a)));
    return [x1, Math.max(y1, top), x2, Math.max(y2, top)];
  }

  fill(corners) {
    const c = this.context;
    c.beginPath();
    for (const [x, y] of corners) c.lineTo(...this.pixel(x, y));
    c.closePath();
    c.fill();
  }

  drawTrail(motion, frame) {
    const c = this.context, path = motion.path;
    c.lineWidth = Math.max(0.03 * this.scene.radius * this.scale, 1.5);
    c.lineCap = "butt";
    const stride = Math.max(Math.floor(path.length / 90), 1);
    for (let k = stride; k < path.length; k += stride) {
      const age = (frame.t - path[k][0]) / TRAIL;
      if (age < 0 || age > 1) continue;
      c.strokeStyle = `rgb(${this.colours.trail} / ${0.55 * (1 - age) ** 1.5})`;
      c.beginPath();
      c.moveTo(...this.pixel(path[k - stride][1], path[k - stride][2]));
      c.lineTo(...this.pixel(path[k][1], path[k][2]));
      c.stroke();
    }
  }

  drawBody(frame) {
    const c = this.context, { scene } = this, [low, high] = scene.pressure_range;
    const at = scene.mass.map((_, i) => this.pixel(frame.position[2 * i], frame.position[2 * i + 1]));
    c.fillStyle = pressureColour((frame.pressure - low) / (high - low));
    for (const loop of scene.chambers) {
      c.beginPath();
      for (const i of loop) c.lineTo(...at[i]);
      c.closePath();
      c.fill();
    }
    const side = (scene.side.reduce((sum, s) => sum + s, 0) / scene.side.length) * this.scale;
    const [shortest, longest] = scene.spring_range, reach = Math.max(1 - shortest, longest - 1, 0.05);
    c.lineCap = "butt";
    for (const [width, ink] of [[0.46, true], [0.3, false]]) {
      scene.springs.forEach(([a, b], j) => {
        const length = Math.hypot(at[a][0] - at[b][0], at[a][1] - at[b][1]) / this.scale;
        c.strokeStyle = ink ? INK : shade(STRAIN_MAP, 0.5 + (length / scene.rest[j] - 1) / (2 * reach));
        c.lineWidth = width * side;
        c.beginPath();
        c.moveTo(...at[a]);
        c.lineTo(...at[b]);
        c.stroke();
      });
    }
    at.forEach(([x, y], i) => {
      const touching = frame.touch[i] > 0, half = (scene.side[i] * this.scale) / 2;
      c.save();
      c.translate(x, y);
      c.rotate(-scene.angle[i]);
      c.fillStyle = touching ? TOUCHING_EDGE : MASS_EDGE;
      c.fillRect(-half, -half, 2 * half, 2 * half);
      c.fillStyle = touching ? TOUCHING : MASS;
      c.fillRect(-0.72 * half, -0.72 * half, 1.44 * half, 1.44 * half);
      c.restore();
    });
    const [x, y] = this.pixel(...frame.com);
    for (const [radius, colour] of [[5, INK], [3.4, "white"]]) {
      c.fillStyle = colour;
      c.beginPath();
      c.arc(x, y, radius, 0, 2 * Math.PI);
      c.fill();
    }
  }

  /** A rubber band from a mass to the pointer. */
  drawHand(frame, { mass, pointer }) {
    const c = this.context, from = this.pixel(frame.position[2 * mass], frame.position[2 * mass + 1]);
    c.strokeStyle = c.fillStyle = this.colours.hand;
    c.lineWidth = 2;
    c.setLineDash([5, 4]);
    c.beginPath();
    c.moveTo(...from);
    c.lineTo(...pointer);
    c.stroke();
    c.setLineDash([]);
    c.beginPath();
    c.arc(...pointer, 5, 0, 2 * Math.PI);
    c.fill();
    c.beginPath();
    c.arc(...from, Math.max(0.75 * this.scene.side[mass] * this.scale, 9), 0, 2 * Math.PI);
    c.stroke();
  }

  /** The mass nearest to a point of the canvas, or null if none is near. */
  nearest(position, px, py) {
    let best = null, least = Math.max(44, 0.75 * this.scene.radius * this.scale);
    for (let i = 0; i < this.scene.masses; i++) {
      const [x, y] = this.pixel(position[2 * i], position[2 * i + 1]), distance = Math.hypot(x - px, y - py);
      if (distance < least) [best, least] = [i, distance];
    }
    return best;
  }
}

/** Corners of a wall [x1, y1, x2, y2] with a thickness, away from its free side, which is on the right. */
function reachBack([x1, y1, x2, y2], thickness) {
  const length = Math.hypot(x2 - x1, y2 - y1), bx = ((y1 - y2) / length) * thickness, by = ((x2 - x1) / length) * thickness;
  return [[x1, y1], [x2, y2], [x2 + bx, y2 + by], [x1 + bx, y1 + by]];
}

/** What walls stand for: closed loops are blocks, behind others is the rest of the world. */
function solids(walls) {
  const key = (x, y) => `${x.toFixed(6)} ${y.toFixed(6)}`, start = new Map(walls.map((w, k) => [key(w[0], w[1]), k]));
  const seen = new Set(), out = [];
  walls.forEach((_, first) => {
    if (seen.has(first)) return;
    const loop = [];
    let k = first;
    while (k !== undefined && !seen.has(k)) {
      seen.add(k);
      loop.push(k);
      k = start.get(key(walls[k][2], walls[k][3]));
    }
    if (k === first && loop.length > 2) out.push(loop.map((j) => walls[j].slice(0, 2)));
    else for (const j of loop) out.push(reachBack(walls[j], FAR));
  });
  return out;
}
