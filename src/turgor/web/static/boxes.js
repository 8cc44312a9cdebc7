// Box plots, lying: quartiles, median, whiskers to the last value within 1.5 interquartile ranges, every value a dot.

import { number, s, ticks } from "./elements.js";

/** The quantile `q` of ascending `values`, linear between two of them as NumPy has it. */
export function quantile(values, q) {
  const at = (values.length - 1) * q, k = Math.floor(at);
  return k + 1 < values.length ? values[k] + (values[k + 1] - values[k]) * (at - k) : values[k];
}

/** The five numbers of a box plot, null for no values. */
export function five(values) {
  const v = values.filter(Number.isFinite).sort((a, b) => a - b);
  if (!v.length) return null;
  const [q1, median, q3] = [0.25, 0.5, 0.75].map((q) => quantile(v, q));
  const reach = 1.5 * (q3 - q1);
  return { low: v.find((x) => x >= q1 - reach), q1, median, q3, high: v.findLast((x) => x <= q3 + reach), count: v.length };
}

/**
 * An SVG of `rows`, each {values, kind (a class), hrefs, names, mark}, over the same scale `range`, by default what they
 * span; `axis` writes it below.
 */
export function box(rows, { range = null, unit = "", axis = false, height = 34 } = {}) {
  const width = 320, side = 8;
  const every = rows.flatMap((row) => [...row.values, row.mark]).filter(Number.isFinite);
  let [low, high] = range ?? [Math.min(...every), Math.max(...every)];
  if (!range || low === high) [low, high] = [low - (high - low || 0.1) * 0.05, high + (high - low || 0.1) * 0.05];
  const x = (value) => side + ((value - low) / (high - low)) * (width - 2 * side);
  const total = rows.length * height + (axis ? 22 : 0);
  const told = rows.map((row) => {
    const found = five(row.values);
    return found ? `median ${number(found.median)} ${unit}, quartiles ${number(found.q1)} and ${number(found.q3)}, ${found.count} values` : "no values";
  });
  const svg = s("svg", { class: "box", viewBox: `0 0 ${width} ${total}`, role: "group", "aria-label": told.join("; ") });
  if (axis) svg.append(...axisOf(low, high, x, total, unit));
  else if (low < 0 && high > 0) svg.append(s("line", { class: "zero", x1: x(0), x2: x(0), y1: 0, y2: total }));
  rows.forEach((row, k) => svg.append(plot(row, x, (k + 0.5) * height, height, unit)));
  return svg;
}

function plot(row, x, y, height, unit) {
  const group = s("g", { class: `plot ${row.kind ?? ""}` });
  const found = five(row.values);
  if (!found) return group;
  const half = height * 0.27;
  const at = { y1: y, y2: y };
  group.append(
    s("line", { class: "whisker", x1: x(found.low), x2: x(found.q1), ...at }),
    s("line", { class: "whisker", x1: x(found.q3), x2: x(found.high), ...at }),
    s("rect", { x: x(found.q1), y: y - half, width: Math.max(x(found.q3) - x(found.q1), 1), height: 2 * half, rx: 2 }),
  );
  row.values.forEach((value, k) => {
    if (!Number.isFinite(value)) return;
    const lift = ((k * 0.618) % 1) - 0.5; // spread, the same at every drawing
    const dot = s("circle", { class: "value", cx: x(value), cy: y + lift * half * 1.2, r: 3 },
      s("title", {}, `${row.names?.[k] ?? ""} ${number(value, 3)} ${unit}`.trim()));
    const href = row.hrefs?.[k];
    group.append(href ? s("a", { href, "aria-label": `${row.names?.[k] ?? "run"}: ${number(value, 3)} ${unit}` }, dot) : dot);
  });
  group.append(s("line", { class: "median", x1: x(found.median), x2: x(found.median), y1: y - half, y2: y + half }));
  if (Number.isFinite(row.mark)) {
    const m = x(row.mark);
    group.append(s("path", { class: "mark", d: `M${m} ${y - half - 6}l4 4l-4 4l-4 -4z` }, s("title", {}, `${row.markName}: ${number(row.mark, 3)} ${unit}`)));
  }
  return group;
}

function axisOf(low, high, x, total, unit) {
  const { at, digits } = ticks(low, high, 4);
  return at.flatMap((value, k) => [
    s("line", { class: value === 0 ? "zero" : "grid", x1: x(value), x2: x(value), y1: 0, y2: total - 17 }),
    s("text", { x: x(value), y: total - 4, "text-anchor": "middle" }, number(value, digits) + (k === at.length - 1 && unit ? ` ${unit}` : "")),
  ]);
}
