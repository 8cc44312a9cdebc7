// Replays: the binary file of turgor/web/replay.py, read into plain typed arrays. Index t is the state after step t.

const CAMERA_SMOOTHING = [0.4, 0.7]; // [s], standard deviation of the Gaussian over the path in x and y
const SPEED_WINDOW = 1; // [s]

const TYPES = { int16: Int16Array, int32: Int32Array, uint8: Uint8Array, float32: Float32Array };

/** The `Replay` in an ArrayBuffer or a Uint8Array; throws an Error of one line for anything else. */
export async function loadReplay(data) {
  const bytes = data instanceof Uint8Array ? data : new Uint8Array(data);
  if (bytes.length < 8 || String.fromCharCode(...bytes.subarray(0, 4)) !== "TGR1") {
    throw new Error("replay: expected a file that begins with TGR1");
  }
  const end = 8 + new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength).getUint32(4, true);
  const header = JSON.parse(new TextDecoder().decode(bytes.subarray(8, end)));
  if (header.format !== 1) throw new Error(`replay: expected format 1; got ${header.format}`);
  const deflated = new Blob([bytes.subarray(end)]).stream().pipeThrough(new DecompressionStream("deflate"));
  const stream = await new Response(deflated).arrayBuffer();
  const arrays = {};
  let first = 0;
  for (const { name, type, shape } of header.arrays) {
    const size = shape.reduce((a, b) => a * b, 1) * TYPES[type].BYTES_PER_ELEMENT;
    arrays[name] = new TYPES[type](stream.slice(first, first + size)); // a copy: aligned
    first += size;
  }
  return new Replay(header, arrays);
}

/** What one agent did. Rows of all arrays follow each other: position[2 * (t * masses + i)] is x of mass i. */
export class Replay {
  constructor(header, arrays) {
    this.header = header;
    this.dt = header.dt; // [s]
    this.steps = header.steps;
    this.masses = header.masses;
    this.springs = header.springs.length;
    this.chambers = header.chambers.length;
    this.duration = header.steps * header.dt; // [s]
    this.pressure = arrays.pressure; // [Pa], [step + 1, chamber]
    this.position = this.#positions(arrays.origin, arrays.position); // [m], [step + 1, mass, 2]
    this.rest = this.#lengths(arrays.rest); // [m], commanded, [step + 1, spring]
    this.touch = this.#touches(arrays.touch); // 0 or 1, [step + 1, mass]
    this.com = this.#centres(); // [m], [step + 1, 2]
    this.velocity = differences(this.com, this.dt); // of the centre of mass [m/s], [step + 1, 2]
    this.speed = this.#speeds(); // in x over the last second [m/s], [step + 1]
    this.areaRatio = this.#areaRatios(); // [1], [step + 1, chamber]
    this.path = smoothedPath(this.com, this.dt); // [m], what the camera follows, [step + 1, 2]
  }

  /** Present length of spring j / L0 [1]. */
  strain(t, j) {
    const [a, b] = this.header.springs[j];
    const p = this.position;
    const i = 2 * (t * this.masses + a);
    const k = 2 * (t * this.masses + b);
    return Math.hypot(p[k] - p[i], p[k + 1] - p[i + 1]) / this.header.rest[j];
  }

  /** The step that is nearest to a time [s]. */
  stepAt(time) {
    return Math.min(Math.max(Math.round(time / this.dt), 0), this.steps);
  }

  #positions(origin, moved) {
    const row = 2 * this.masses;
    const position = new Float32Array((this.steps + 1) * row);
    const here = Array.from(origin); // [mm], whole numbers: nothing is lost
    for (let k = 0; k < row; k++) position[k] = here[k] / 1000;
    for (let k = 0; k < moved.length; k++) {
      here[k % row] += moved[k];
      position[row + k] = here[k % row] / 1000;
    }
    return position;
  }

  #lengths(levels) {
    const { spring_range: [low, high], rest } = this.header;
    return Float32Array.from(levels, (level, k) => (low + (level * (high - low)) / 255) * rest[k % this.springs]);
  }

  #touches(bits) {
    const wide = Math.ceil(this.masses / 8);
    const touch = new Uint8Array((this.steps + 1) * this.masses);
    for (let t = 0; t <= this.steps; t++) {
      for (let i = 0; i < this.masses; i++) {
        touch[t * this.masses + i] = (bits[t * wide + (i >> 3)] >> (7 - (i & 7))) & 1;
      }
    }
    return touch;
  }

  #centres() {
    const mass = this.header.mass;
    const total = mass.reduce((a, b) => a + b, 0);
    const com = new Float32Array(2 * (this.steps + 1));
    for (let t = 0; t <= this.steps; t++) {
      let x = 0;
      let y = 0;
      for (let i = 0; i < this.masses; i++) {
        x += mass[i] * this.position[2 * (t * this.masses + i)];
        y += mass[i] * this.position[2 * (t * this.masses + i) + 1];
      }
      com[2 * t] = x / total;
      com[2 * t + 1] = y / total;
    }
    return com;
  }

  #speeds() {
    const speed = new Float32Array(this.steps + 1);
    const window = Math.max(Math.round(SPEED_WINDOW / this.dt), 1);
    for (let t = 1; t <= this.steps; t++) {
      const n = Math.min(window, t);
      speed[t] = (this.com[2 * t] - this.com[2 * (t - n)]) / (n * this.dt);
    }
    return speed;
  }

  #areaRatios() {
    const { chambers, area_reference: reference } = this.header;
    const ratio = new Float32Array((this.steps + 1) * this.chambers);
    const p = this.position;
    for (let t = 0; t <= this.steps; t++) {
      const row = 2 * t * this.masses;
      chambers.forEach((loop, c) => {
        let area = 0;
        for (let n = 0; n < loop.length; n++) {
          const i = row + 2 * loop[n];
          const k = row + 2 * loop[(n + 1) % loop.length];
          area += 0.5 * (p[i] * p[k + 1] - p[k] * p[i + 1]);
        }
        ratio[t * this.chambers + c] = area / reference[c];
      });
    }
    return ratio;
  }
}

/** Central differences of rows of two [1/s]. */
function differences(values, dt) {
  const last = values.length / 2 - 1;
  const out = new Float32Array(values.length);
  for (let t = 0; t <= last; t++) {
    const a = Math.max(t - 1, 0);
    const b = Math.min(t + 1, last);
    for (const k of [0, 1]) out[2 * t + k] = b > a ? (values[2 * b + k] - values[2 * a + k]) / ((b - a) * dt) : 0;
  }
  return out;
}

/** Rows of two under a Gaussian in time, the ends held. */
function smoothedPath(values, dt) {
  const last = values.length / 2 - 1;
  const out = new Float32Array(values.length);
  CAMERA_SMOOTHING.forEach((seconds, axis) => {
    const deviation = seconds / dt;
    const reach = Math.ceil(3 * deviation);
    const kernel = Float64Array.from({ length: 2 * reach + 1 }, (_, n) => Math.exp(-0.5 * ((n - reach) / deviation) ** 2));
    const total = kernel.reduce((a, b) => a + b, 0);
    for (let t = 0; t <= last; t++) {
      let sum = 0;
      for (let n = -reach; n <= reach; n++) {
        sum += kernel[n + reach] * values[2 * Math.min(Math.max(t + n, 0), last) + axis];
      }
      out[2 * t + axis] = sum / total;
    }
  });
  return out;
}
