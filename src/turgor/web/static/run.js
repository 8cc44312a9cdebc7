// One run: its numbers, its curves while they grow, its champion moving, how it was made.

import { box } from "./boxes.js";
import { Curves, History } from "./curves.js";
import { ask, badge, compareHref, count, failure, h, number, title } from "./elements.js";
import { showReplays } from "./films.js";

export function show(element, store, path = "") {
  const head = h("div", { class: "head" });
  const tiles = h("dl", { class: "tiles" });
  const plot = h("div");
  const film = h("div", { class: "film" });
  const robust = h("div", { class: "robust" });
  const facts = h("div", { class: "facts" });
  const history = new History({ generation: [], evaluations: [], best: [], median: [], sigma: [], seconds: [] });
  const newer = h("button", { type: "button", hidden: true, onclick: () => ((filmed = null), load()) }, "A better one was found: play it");
  let details = null, curves = null, ended = false, endFilm = null, loading = false, filmed = null; // fitness of the agent that plays

  element.append(
    h("p", { class: "back" }, h("a", { href: "#/" }, "← all runs")), head, tiles,
    h("section", { class: "card" }, h("h2", {}, "Fitness"), plot),
    h("section", { class: "card" }, h("h2", {}, "Champion"), film),
    robust, facts,
  );

  async function load() {
    loading = true;
    try {
      details = await ask("run", path);
    } catch (error) {
      if (!ended) head.replaceChildren(h("h1", {}, path || store.folder), failure(error.message));
      return;
    } finally {
      loading = false;
    }
    if (ended) return;
    history.columns = details.history;
    curves ??= new Curves(plot, [history], { unit: details.unit });
    curves.draw();
    draw();
    drawFacts();
    drawFilm();
  }

  function draw() {
    const run = store.runs.get(path) ?? details;
    if (!run || !details) return;
    document.title = `${run.status === "running" ? `${number(run.fitness)} ` : ""}${run.name} ${run.body} s${run.seed} · turgor`;
    head.replaceChildren(
      h("h1", {}, title(run)),
      h("p", { class: "muted" }, badge(run.status), ` ${path || store.folder}`, run.note ? ` – ${run.note}` : ""),
      details.problem ? failure(details.problem) : "",
    );
    const unit = run.unit ? ` ${run.unit}` : "";
    const { champion } = details;
    const solved = champion?.solved ?? null;
    const found = history.columns.best.findIndex((best) => best === run.fitness);
    const judged = champion?.judged ? `${champion.judged}, ` : ""; // of a robust run
    tiles.replaceChildren(...[
      ["fitness", number(run.fitness, 3) + unit, found < 0 ? "" : `${judged}found in generation ${count(history.columns.generation[found])}`],
      ["robust", number(run.robust, 3) + (run.robust === null ? "" : unit), run.robust !== null ? "median of moved starts" : run.status === "running" ? "measured at the end" : "not measured"],
      solved === null ? null : ["task", solved ? "solved" : "not solved", solved ? `${judged}in ${number(champion.steps * details.task.dt, 1)} s` : ""],
      ["evaluations", count(run.evaluations), `of ${count(run.budget)}, generation ${count(run.generation)}`],
      ["step size σ", number(run.sigma, 4), run.strategy],
    ].filter(Boolean).map(([name, value, note]) =>
      h("div", {}, h("dt", {}, name), h("dd", {}, h("b", {}, value), h("small", {}, note)))));
  }

  function drawFilm() {
    if (!details.champion) return film.replaceChildren(h("p", { class: "muted" }, "There is no champion yet."));
    if (filmed !== null) return; // one that plays is not taken away
    filmed = details.champion.fitness;
    newer.hidden = true;
    const stage = h("div");
    const play = (which) => {
      endFilm?.();
      endFilm = showReplays(stage, [{ path, which }]);
    };
    const { solver, fitness } = details.champion;
    const other = solver !== null && solver !== fitness;
    film.replaceChildren(
      newer,
      other ? h("div", { class: "choice", role: "group", "aria-label": "Which agent" },
        pick("best", "Best fitness", true), pick("solver", "Best that solves the task", false)) : "",
      stage,
    );
    function pick(which, text, on) {
      return h("button", { type: "button", "aria-pressed": String(on), onclick: (event) => {
        for (const b of event.target.parentElement.children) b.setAttribute("aria-pressed", String(b === event.target));
        play(which);
      } }, text);
    }
    play("best");
  }

  function drawFacts() {
    const { settings, task, versions, seconds, champion } = details;
    robust.replaceChildren();
    if (champion?.robust) {
      const mark = champion.judged ? `what it was chosen for: ${champion.judged}` : "its own start";
      const starts = champion.robust_solved === null ? "" : ` It solves the task from ${champion.robust_solved} of them.`;
      robust.append(h("section", { class: "card luck" }, h("h2", {}, "Luck"),
        h("p", { class: "muted" }, `The champion from ${champion.robust.length} starts moved by a millionth of a metre; the diamond is ${mark}.${starts}`),
        box([{ values: champion.robust, mark: champion.fitness, markName: champion.judged ?? "from its own start" }], { unit: details.unit, axis: true })));
    }
    const others = [...store.runs.values()].filter((run) => run.path !== path).sort((a, b) => (alike(b) - alike(a)) || (a.path < b.path ? -1 : 1));
    const select = h("select", { "aria-label": "Compare with", onchange: () => select.value && (location.hash = compareHref(path, select.value)) },
      h("option", { value: "" }, "another run …"), others.slice(0, 500).map((run) => h("option", { value: run.path }, title(run))));
    const table = (name, entries) => h("details", {}, h("summary", {}, name), h("dl", { class: "pairs" },
      Object.entries(entries ?? {}).filter(([, value]) => value !== null && typeof value !== "object").map(([key, value]) =>
        [h("dt", {}, key.replaceAll("_", " ")), h("dd", {}, typeof value === "number" && !Number.isInteger(value) ? number(value, 3) : String(value))])));
    facts.replaceChildren(
      others.length ? h("p", {}, h("label", {}, "Compare with ", select)) : "",
      table("Settings", { ...settings, ...settings?.recipe, ...named("robust", settings?.robust) }), table("Task", task), table("Time [s]", seconds), table("Versions", versions),
    );
  }

  const named = (prefix, entries) => Object.fromEntries(Object.entries(entries ?? {}).map(([key, value]) => [`${prefix} ${key}`, value]));
  const alike = (run) => ["name", "body", "condition"].filter((key) => run[key] === details[key]).length;

  function onLibrary() {
    const run = store.runs.get(path);
    if (run && details && run.status !== details.status) load();
    else draw();
    newer.hidden = filmed === null || !(run?.kept > filmed);
  }

  function onRows(event) {
    if (event.detail.path !== path || !details) return;
    if (!history.take(event.detail.rows, event.detail.first)) return void load();
    curves.draw();
    if (filmed === null && !loading) load(); // there may be a champion now
  }

  load();
  store.addEventListener("library", onLibrary);
  store.addEventListener("rows", onRows);
  store.addEventListener("anew", load);
  return () => {
    ended = true;
    store.removeEventListener("library", onLibrary);
    store.removeEventListener("rows", onRows);
    store.removeEventListener("anew", load);
    curves?.end();
    endFilm?.();
  };
}
