// Elements of the page, and numbers as text.

const SVG = "http://www.w3.org/2000/svg";

/** An element with attributes (`onclick` and the like are listeners) and children (elements, text, null for none). */
export function h(tag, attributes = {}, ...children) {
  return filled(document.createElement(tag), attributes, children);
}

/** The same for SVG. */
export function s(tag, attributes = {}, ...children) {
  return filled(document.createElementNS(SVG, tag), attributes, children);
}

function filled(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined));
  return element;
}

/** A number with a true minus sign; "–" for none. */
export function number(value, digits = 2) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  return value.toFixed(digits).replace("-", "−");
}

/** A whole number with thin spaces between thousands. */
export function count(value) {
  return String(value).replace(/\B(?=(\d{3})+$)/g, "\u202f");
}

/** How long ago, in words. */
export function ago(seconds) {
  const passed = Math.max(Date.now() / 1000 - seconds, 0);
  for (const [length, unit] of [[86400, "d"], [3600, "h"], [60, "min"]]) {
    if (passed >= length) return `${Math.floor(passed / length)} ${unit} ago`;
  }
  return "just now";
}

/** A run's name in words. */
export function title(run) {
  const parts = [run.name, run.body, run.condition];
  if (run.controller !== "linear") parts.push(run.controller);
  parts.push(`seed ${run.seed}`);
  if (run.change) parts.push(run.change);
  return parts.join(" · ");
}

/** The state as a badge. */
export function badge(status) {
  return h("span", { class: `badge ${status}` }, status);
}

export const runHref = (path) => `#/run/${encodeURIComponent(path)}`;
export const campaignHref = (path) => `#/campaign/${encodeURIComponent(path)}`;
export const compareHref = (a, b) => `#/compare/${encodeURIComponent(a)}/${encodeURIComponent(b)}`;

/** What the server answers to `kind` ("run", "replay", "campaign") of a path; throws an Error of one line. */
export async function ask(kind, path = null, query = "") {
  const tail = path === null ? "" : `/${path.split("/").map(encodeURIComponent).join("/")}`;
  let response;
  try {
    response = await fetch(`api/${kind}${tail}${query}`);
  } catch {
    throw new Error("The server does not answer. Is turgor view still running?");
  }
  if (!response.ok) {
    const told = await response.json().catch(() => ({}));
    throw new Error(told.error ?? `The server answered ${response.status}.`);
  }
  return response.headers.get("content-type").startsWith("application/json")
    ? response.json()
    : response.arrayBuffer();
}

/** Loads a style sheet that only some views need. */
export function style(href) {
  if (document.querySelector(`link[href="${href}"]`)) return;
  document.head.append(h("link", { rel: "stylesheet", href }));
}

/** A clear message in the place of what could not be shown. */
export function failure(message) {
  return h("p", { class: "failure", role: "alert" }, message);
}

/** Round numbers from `low` to `high`, about `wanted` of them, and the digits that they need. */
export function ticks(low, high, wanted) {
  const raw = (high - low) / Math.max(wanted, 1);
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((m) => m * power).find((m) => m >= raw * 0.999);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + step * 1e-9; k++) found.push(k * step);
  return { at: found, digits: Math.max(0, -Math.floor(Math.log10(step) + 1e-9)) };
}
