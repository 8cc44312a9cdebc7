// Two runs side by side: numbers, curves over the same axes, both champions at once.

import { box } from "./boxes.js";
import { Curves, History } from "./curves.js";
import { ask, badge, compareHref, count, failure, h, number, runHref, title } from "./elements.js";
import { showReplays } from "./films.js";

export function show(element, store, a = "", b = "") {
  const paths = [a, b];
  const body = h("div");
  let ended = false, curves = null, endFilm = null, histories = [];
  document.title = "compare · turgor";
  element.append(h("p", { class: "back" }, h("a", { href: "#/" }, "← all runs")), h("div", { class: "head" }, h("h1", {}, "Side by side")), body);

  async function load() {
    try {
      const runs = await Promise.all(paths.map((path) => ask("run", path)));
      if (!ended) draw(runs);
    } catch (error) {
      if (!ended) body.replaceChildren(failure(error.message));
    }
  }

  function draw(runs) {
    curves?.end();
    endFilm?.();
    histories = runs.map((run) => new History(run.history));
    const plot = h("div"), film = h("div", { class: "film" });
    const rows = [
      ["run", (run, k) => h("a", { href: runHref(paths[k]) }, title(run))],
      ["state", (run) => badge(run.status)],
      ["fitness", (run) => h("b", {}, `${number(run.fitness, 3)} ${run.unit}`)],
      ["robust", (run) => `${number(run.robust, 3)} ${run.unit}`],
      ["evaluations", (run) => count(run.evaluations)],
      ["generation", (run) => count(run.generation)],
      ["strategy", (run) => run.strategy],
      ["parameters", (run) => (run.task ? count(run.task.parameters) : "–")],
    ];
    const robust = runs.map((run, k) => ({ values: run.champion?.robust ?? [], kind: `run${k}`, mark: run.champion?.fitness, markName: run.champion?.judged ?? "from its own start" }));
    body.replaceChildren(
      h("section", { class: "card" }, h("table", { class: "two" },
        h("thead", {}, h("tr", {}, h("td"), ["A", "B"].map((name, k) => h("th", { scope: "col" }, h("span", { class: `key best run${k}` }, name))))),
        h("tbody", {}, rows.map(([name, cell]) => h("tr", {}, h("th", { scope: "row" }, name), runs.map((run, k) => h("td", {}, cell(run, k))))))),
        h("p", {}, h("a", { class: "button", href: compareHref(b, a) }, "Swap"))),
      h("section", { class: "card" }, h("h2", {}, "Fitness"), plot),
      robust.some((row) => row.values.length) ? h("section", { class: "card luck" }, h("h2", {}, "Luck"),
        h("p", { class: "muted" }, "Each champion from starts moved by a millionth of a metre."), box(robust, { unit: runs[0].unit, axis: true })) : "",
      h("section", { class: "card" }, h("h2", {}, "Champions"), film),
    );
    curves = new Curves(plot, histories, { unit: runs[0].unit, names: ["A", "B"] });
    if (runs.every((run) => run.champion)) endFilm = showReplays(film, paths.map((path) => ({ path, which: "best" })));
    else film.append(h("p", { class: "muted" }, "One of them has no champion yet."));
  }

  function onRows(event) {
    const { path, rows, first } = event.detail;
    paths.forEach((one, k) => one === path && histories[k]?.take(rows, first));
    if (paths.includes(path)) curves?.draw();
  }

  load();
  store.addEventListener("rows", onRows);
  return () => {
    ended = true;
    store.removeEventListener("rows", onRows);
    curves?.end();
    endFilm?.();
  };
}
