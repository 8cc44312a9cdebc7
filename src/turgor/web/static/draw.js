// Pictures: a world and a body on a Canvas 2D, in the colours and proportions of turgor's videos (turgor/view).

export const BODY_SHARE = 1 / 3; // [1], the body's size at rest / the picture's height
export const BODY_HEIGHT = 0.6; // [1], where the camera's centre lies, from the top of the picture
const TRAIL_LENGTH = 8; // [s]
const SURFACE = 0.15; // [m], of the lighter line along everything that can be touched

// Lightness falls evenly from low to high pressure; greens stay apart from the springs' red and blue.
const PRESSURE_COLOURS = [[247, 252, 214], [201, 233, 160], [120, 198, 121], [49, 145, 96], [0, 88, 66]];
// ColorBrewer's RdBu: blue compressed, near white at rest, red stretched.
const STRAIN_COLOURS = [[5, 48, 140], [67, 147, 210], [247, 247, 247], [236, 112, 84], [178, 10, 35]];

export const PRESSURE_MAP = table(PRESSURE_COLOURS);
export const STRAIN_MAP = table(STRAIN_COLOURS);

const LIGHT = {
  sky: ["#c4d9ec", "#f6f9fb"], grid: "#cdd9e4", solid: "#424854", edge: "#8a95a5", tick: "#929cab", tickText: "#d6dce5",
  ink: "#1c222c", mass: "#747f90", massEdge: "#282f3c", touching: "#222732", touchingEdge: "#ffb000",
  centre: "#ffffff", trail: "58, 66, 82", panel: "rgba(250, 252, 253, 0.75)", text: "#1c222c", faint: "#4d5765",
};
const DARK = {
  ...LIGHT, sky: ["#0d1320", "#243349"], grid: "#2b394d", solid: "#3a414d", edge: "#7d8899", tick: "#8791a1",
  ink: "#0a0d13", mass: "#94a0b3", trail: "205, 216, 232", panel: "rgba(14, 19, 28, 0.72)", text: "#eef2f7",
  faint: "#aeb8c6",
};
export const PALETTES = { light: LIGHT, dark: DARK };

/** 256 colours of CSS through `colours`. */
function table(colours) {
  return Array.from({ length: 256 }, (_, n) => {
    const place = (n / 255) * (colours.length - 1);
    const k = Math.min(Math.floor(place), colours.length - 2);
    return `rgb(${colours[k].map((a, c) => Math.round(a + (place - k) * (colours[k + 1][c] - a))).join()})`;
  });
}

/** The colour of `value` in a map that spans `limits`. */
export function shade(map, value, [low, high]) {
  const share = high > low ? (value - low) / (high - low) : 0.5;
  return map[Math.round(255 * Math.min(Math.max(share, 0), 1)) || 0];
}

/** Where a picture of width x height [px] lies in the world: `x`, `y` [m] stand at BODY_HEIGHT in its middle. */
export class Camera {
  constructor(x, y, scale, width, height) {
    Object.assign(this, { x, y, scale, width, height }); // scale [px/m]
    this.left = x - width / scale / 2;
    this.right = x + width / scale / 2;
    this.low = y - ((1 - BODY_HEIGHT) * height) / scale;
  }
  px(x) {
    return (x - this.left) * this.scale;
  }
  py(y) {
    return this.height - (y - this.low) * this.scale;
  }
  /** Distance of the labelled marks [m]. */
  get spacing() {
    const least = (0.155 * Math.max(Math.min(this.width, this.height), 300)) / this.scale;
    const power = 10 ** Math.floor(Math.log10(least));
    return [1, 2, 5, 10].map((m) => m * power).find((d) => d >= least);
  }
}

/** The scale [px/m] at which a body of this extent [m] fills its share of the picture. */
export function bodyScale(extent, width, height) {
  return (BODY_SHARE * Math.min(width, height)) / Math.max(extent, 3);
}

/** A scene, cut so that drawing it costs what is in view, not what there is. */
export class World {
  constructor({ segments, depth, solid = [], surface = [] }) {
    this.ground = segments
      .filter((s, k) => depth[k] > 0 && s[0] !== s[2])
      .map(([x1, y1, x2, y2]) => (x1 < x2 ? [x1, y1, x2, y2] : [x2, y2, x1, y1]))
      .sort((a, b) => a[0] - b[0]);
    this.reach = []; // how far to the right anything up to here comes
    for (const [, , x2] of this.ground) this.reach.push(Math.max(x2, this.reach.at(-1) ?? -Infinity));
    this.solid = solid;
    this.surface = surface;
  }

  /** [x1, y1, x2, y2] of the ground between two x [m], cut there. */
  between(left, right) {
    let [a, b] = [0, this.reach.length];
    while (a < b) {
      const middle = (a + b) >> 1;
      if (this.reach[middle] < left) a = middle + 1;
      else b = middle;
    }
    const found = [];
    for (let k = a; k < this.ground.length && this.ground[k][0] <= right; k++) {
      const [x1, y1, x2, y2] = this.ground[k];
      if (x2 < left) continue;
      const slope = (y2 - y1) / (x2 - x1);
      const [u, v] = [Math.max(x1, left), Math.min(x2, right)];
      found.push([u, y1 + slope * (u - x1), v, y1 + slope * (v - x1)]);
    }
    return found;
  }

  draw(context, camera, palette, { ruler = true, text = 1 } = {}) {
    const { width, height } = camera;
    const sky = context.createLinearGradient(0, 0, 0, height);
    palette.sky.forEach((colour, k) => sky.addColorStop(k, colour));
    context.fillStyle = sky;
    context.fillRect(0, 0, width, height);
    this.#drawGrid(context, camera, palette);
    const ground = this.between(camera.left, camera.right);
    this.#drawGround(context, camera, palette, ground);
    for (const [polygons, colour] of [[this.solid, palette.solid], [this.surface, palette.edge]]) {
      context.fillStyle = context.strokeStyle = colour;
      context.lineWidth = 1;
      context.beginPath();
      for (const corners of polygons) {
        corners.forEach(([x, y], k) => context[k ? "lineTo" : "moveTo"](camera.px(x), camera.py(y)));
        context.closePath();
      }
      context.fill("nonzero");
      if (colour === palette.solid) context.stroke(); // no seam where two meet
    }
    if (ruler) this.#drawRuler(context, camera, palette, ground, text);
  }

  #drawGrid(context, camera, palette) {
    const { spacing } = camera;
    context.strokeStyle = palette.grid;
    context.lineWidth = 1;
    context.beginPath();
    for (let k = Math.ceil(camera.left / spacing); k * spacing <= camera.right; k++) {
      const x = camera.px(k * spacing);
      context.moveTo(x, 0);
      context.lineTo(x, camera.height);
    }
    context.stroke();
  }

  #drawGround(context, camera, palette, ground) {
    for (const [colour, thick] of [[palette.solid, Infinity], [palette.edge, SURFACE]]) {
      context.fillStyle = colour;
      context.beginPath();
      for (const [x1, y1, x2, y2] of ground) {
        // half a pixel further, so that no seam shows between neighbours
        const [a, b] = [camera.px(x1) - 0.3, camera.px(x2) + 0.3];
        const down = (y) => (thick === Infinity ? camera.height + 10 : camera.py(y - thick));
        context.moveTo(a, camera.py(y1));
        context.lineTo(b, camera.py(y2));
        context.lineTo(b, Math.max(down(y2), camera.py(y2)));
        context.lineTo(a, Math.max(down(y1), camera.py(y1)));
        context.closePath();
      }
      context.fill("nonzero");
    }
  }

  #drawRuler(context, camera, palette, ground, text) {
    if (!ground.length) return;
    const { spacing } = camera;
    const parts = spacing * camera.scale >= 80 ? 10 : 5;
    const minor = spacing / parts;
    context.strokeStyle = palette.tick;
    context.fillStyle = palette.tickText;
    context.font = `${13 * text}px system-ui, sans-serif`;
    context.textAlign = "center";
    context.textBaseline = "top";
    context.lineWidth = 1;
    context.beginPath();
    for (let k = Math.ceil(camera.left / minor), n = 0; k * minor <= camera.right; k++) {
      const metres = k * minor;
      while (n < ground.length - 1 && ground[n][2] < metres) n++;
      const [x1, y1, x2, y2] = ground[n];
      if (metres < x1 || metres > x2) continue;
      const top = camera.py(x2 > x1 ? y1 + ((y2 - y1) * (metres - x1)) / (x2 - x1) : y1) + 5 * text;
      const x = camera.px(metres);
      context.moveTo(x, top);
      context.lineTo(x, top + (k % parts ? 4 : 12) * text);
      if (k % parts === 0) context.fillText(`${number(metres)} m`, x, top + 15 * text);
    }
    context.stroke();
  }
}

/** The body between step floor(t) and the next: `t` need not be whole. */
export function drawBody(context, replay, t, camera, palette, { trail = true } = {}) {
  const { header, masses } = replay;
  const [x, y] = pixels(replay, t, camera);
  const step = Math.min(Math.floor(t + 1e-6), replay.steps);
  header.chambers.forEach((loop, c) => {
    context.fillStyle = shade(PRESSURE_MAP, replay.pressure[step * replay.chambers + c], header.pressure_range);
    context.beginPath();
    loop.forEach((i, n) => context[n ? "lineTo" : "moveTo"](x[i], y[i]));
    context.closePath();
    context.fill();
  });
  if (trail) drawTrail(context, replay, t, camera, palette);
  const side = (camera.scale * header.side.reduce((a, b) => a + b, 0)) / masses;
  context.lineCap = "butt";
  context.strokeStyle = palette.ink;
  context.lineWidth = 0.46 * side;
  context.beginPath();
  for (const [a, b] of header.springs) {
    context.moveTo(x[a], y[a]);
    context.lineTo(x[b], y[b]);
  }
  context.stroke();
  context.lineWidth = 0.3 * side;
  header.springs.forEach(([a, b], j) => {
    context.strokeStyle = shade(STRAIN_MAP, replay.strain(step, j), header.strain_range);
    context.beginPath();
    context.moveTo(x[a], y[a]);
    context.lineTo(x[b], y[b]);
    context.stroke();
  });
  for (let i = 0; i < masses; i++) {
    const touching = replay.touch[step * masses + i];
    const size = camera.scale * header.side[i];
    fillSquare(context, x[i], y[i], size, header.angle[i], touching ? palette.touchingEdge : palette.massEdge);
    fillSquare(context, x[i], y[i], 0.72 * size, header.angle[i], touching ? palette.touching : palette.mass);
  }
  const [cx, cy] = centreAt(replay.com, t);
  const dot = Math.min(Math.max(side / 9, 0.5), 1); // smaller in small pictures
  for (const [radius, colour] of [[5 * dot, palette.ink], [3.4 * dot, palette.centre]]) {
    context.fillStyle = colour;
    context.beginPath();
    context.arc(camera.px(cx), camera.py(cy), radius, 0, 2 * Math.PI);
    context.fill();
  }
}

/** Row of two at `t`, which need not be whole. */
export function centreAt(rows, t) {
  const last = rows.length / 2 - 1;
  const a = Math.min(Math.max(Math.floor(t), 0), last);
  const b = Math.min(a + 1, last);
  const share = Math.min(Math.max(t - a, 0), 1);
  return [0, 1].map((k) => rows[2 * a + k] + share * (rows[2 * b + k] - rows[2 * a + k]));
}

function pixels(replay, t, camera) {
  const { masses, position, steps } = replay;
  const a = Math.min(Math.floor(t), steps);
  const b = Math.min(a + 1, steps);
  const x = new Float64Array(masses);
  const y = new Float64Array(masses);
  for (let i = 0; i < masses; i++) {
    const p = 2 * (a * masses + i);
    const q = 2 * (b * masses + i);
    x[i] = camera.px(position[p] + (t - a) * (position[q] - position[p]));
    y[i] = camera.py(position[p + 1] + (t - a) * (position[q + 1] - position[p + 1]));
  }
  return [x, y];
}

/** The centre of mass's path of the last seconds, older parts fainter. */
function drawTrail(context, replay, t, camera, palette) {
  const stride = Math.max(Math.round(0.1 / replay.dt), 1);
  const oldest = Math.max(t - TRAIL_LENGTH / replay.dt, 0);
  context.lineWidth = Math.max(0.03 * replay.header.radius * camera.scale, 1.5);
  let before = centreAt(replay.com, t);
  // multiples of the stride: the corners stay where they are from frame to frame
  for (let step = Math.ceil(t / stride - 1) * stride; step >= oldest; step -= stride) {
    const here = centreAt(replay.com, step);
    const age = ((t - step - stride) * replay.dt) / TRAIL_LENGTH;
    const alpha = 0.55 * Math.min(Math.max(1 - age, 0), 1) ** 1.5;
    context.strokeStyle = `rgba(${palette.trail}, ${alpha.toFixed(3)})`;
    context.beginPath();
    context.moveTo(camera.px(before[0]), camera.py(before[1]));
    context.lineTo(camera.px(here[0]), camera.py(here[1]));
    context.stroke();
    before = here;
  }
}

function fillSquare(context, x, y, side, angle, colour) {
  const [cos, sin] = [0.5 * side * Math.cos(angle), -0.5 * side * Math.sin(angle)]; // y points down here
  context.fillStyle = colour;
  context.beginPath();
  context.moveTo(x + cos - sin, y + sin + cos);
  context.lineTo(x - cos - sin, y - sin + cos);
  context.lineTo(x - cos + sin, y - sin - cos);
  context.lineTo(x + cos + sin, y + sin - cos);
  context.closePath();
  context.fill();
}

/** A number in few digits, with a true minus. */
export function number(value, digits) {
  const text = digits === undefined ? String(Number(value.toPrecision(6))) : value.toFixed(digits);
  return (Number(text) === 0 ? text.replace("-", "") : text).replace("-", "−");
}
