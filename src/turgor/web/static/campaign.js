// A campaign as the paper's grid: task by size by condition, in each cell a box plot of its runs.

import { box, five } from "./boxes.js";
import { ask, badge, failure, h, number, runHref } from "./elements.js";

const SIZES = ["small", "medium", "large", "custom"];
const CONDITIONS = ["pressure", "springs", "passive"];

export function show(element, store, path = "") {
  const head = h("div", { class: "head" }, h("h1", {}, path || store.folder));
  const grids = h("div");
  let measure = "robust", found = null, ended = false, waiting = 0;
  const choice = h("div", { class: "choice", role: "group", "aria-label": "Measure" },
    [["robust", "Robust fitness"], ["fitness", "Best fitness"]].map(([name, text]) =>
      h("button", { type: "button", "aria-pressed": String(name === measure), onclick: (event) => {
        measure = name;
        for (const b of choice.children) b.setAttribute("aria-pressed", String(b === event.target));
        draw();
      } }, text)));
  element.append(h("p", { class: "back" }, h("a", { href: "#/" }, "← all runs")), head, choice, grids);
  document.title = `${path || store.folder} · turgor`;

  async function load() {
    try {
      found = await ask("campaign", path);
    } catch (error) {
      if (!ended) grids.replaceChildren(failure(error.message));
      return;
    }
    if (!ended) draw();
  }

  function draw() {
    const { groups } = found;
    const tasks = [...new Set(groups.map((group) => group.task))].sort((a, b) => (a === "hilly" ? -1 : b === "hilly" ? 1 : a < b ? -1 : 1));
    grids.replaceChildren(...tasks.map(grid));
    if (!groups.length) grids.append(h("p", { class: "muted" }, "No run has begun yet."));
  }

  // Cells without an end of their runs yet have no robust fitness: what they have is shown, in words.
  function grid(task) {
    const groups = found.groups.filter((group) => group.task === task);
    const shown = (group) => group[measure].filter(Number.isFinite);
    const every = groups.flatMap(shown);
    if (!every.length) every.push(0, 1);
    const room = (Math.max(...every) - Math.min(...every) || 1) * 0.04;
    const range = [Math.min(0, ...every) - room, Math.max(...every) + room];
    const plain = groups.filter((group) => !group.change);
    const sizes = SIZES.filter((size) => plain.some((group) => group.body === size));
    const conditions = CONDITIONS.filter((one) => plain.some((group) => group.condition === one));
    const changed = groups.filter((group) => group.change);
    const table = h("table", { class: "grid" },
      h("caption", {}, h("h2", {}, task), h("span", { class: "muted" }, `${measure === "robust" ? "robust" : "best"} fitness [m/s]; every cell has the same scale`)),
      h("thead", {}, h("tr", {}, h("td"), conditions.map((one) => h("th", { scope: "col" }, one)))),
      h("tbody", {}, sizes.map((size, k) => h("tr", {}, h("th", { scope: "row" }, size),
        conditions.map((condition) => cell(plain.find((group) => group.body === size && group.condition === condition), condition, k === sizes.length - 1))))));
    return h("section", { class: "card" }, table, changed.length ? studies(changed, plain) : null);

    function cell(group, label, axis) {
      if (!group) return h("td", { "data-label": label, class: "none" }, "–");
      const numbers = five(group[measure]);
      const running = group.runs.filter((run) => store.runs.get(run)?.status === "running").length;
      const words = numbers ? ["median ", h("b", {}, number(numbers.median)), ` · ${numbers.count} ${numbers.count === 1 ? "run" : "runs"}`] : ["not yet"];
      return h("td", { "data-label": label },
        box([{
          values: group[measure], kind: group.condition,
          hrefs: group.runs.map((run) => (run === null ? null : runHref(run))),
          names: group.runs.map((run, k) => run ?? `seed ${k}`),
        }], { range, unit: "m/s", axis }),
        h("span", { class: "words" }, h("span", {}, words), running ? badge("running") : null));
    }

    function studies(changed, plain) {
      const body = changed[0].body;
      const paper = plain.find((group) => group.body === body && group.condition === "pressure");
      const rows = [...(paper ? [paper] : []), ...changed];
      return h("details", { open: plain.length === 0 }, h("summary", {}, `One thing changed at a time (${changed.length})`),
        h("table", { class: "grid studies" }, h("tbody", {}, rows.map((group, k) =>
          h("tr", {}, h("th", { scope: "row" }, group.change || `as in the paper, ${body}`), cell(group, "", k === rows.length - 1))))));
    }
  }

  // A campaign at work changes all the time; the grid follows every few seconds.
  function later() {
    waiting ||= setTimeout(() => {
      waiting = 0;
      if (!ended) load();
    }, 3000);
  }

  load();
  store.addEventListener("library", later);
  return () => {
    ended = true;
    clearTimeout(waiting);
    store.removeEventListener("library", later);
  };
}
