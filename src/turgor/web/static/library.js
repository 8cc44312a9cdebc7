// The list of runs and campaigns, with what evolves right now.

import { Curves, History } from "./curves.js";
import { ago, ask, badge, campaignHref, compareHref, count, h, number, runHref, title } from "./elements.js";

const COLUMNS = [
  { name: "status", label: "state", cell: (run) => badge(run.status) },
  { name: "name", label: "task", cell: (run) => taskCell(run) },
  { name: "body", label: "body", cell: (run) => run.body },
  { name: "condition", label: "condition", cell: (run) => conditionCell(run) },
  { name: "seed", label: "seed", number: true, cell: (run) => String(run.seed) },
  { name: "fitness", label: "fitness", number: true, cell: (run) => fitnessCell(run) },
  { name: "robust", label: "robust", number: true, cell: (run) => number(run.robust) },
  { name: "evaluations", label: "evaluations", number: true, cell: (run) => progressCell(run) },
  { name: "modified", label: "changed", number: true, cell: (run) => ago(run.modified) },
];
const ORDER = { status: ["running", "failed", "interrupted", "done"], body: ["small", "medium", "large", "custom"] };
const SHOWN = 300; // rows, until more are asked for
const LIVE = 4; // curves of running runs

const view = { text: "", status: "", sort: "modified", down: true }; // kept while the page is open

export function show(element, store) {
  const summary = h("p", { class: "muted" });
  const campaigns = h("div", { class: "campaigns" });
  const live = new Live(store);
  const filter = h("input", {
    type: "search", placeholder: "Filter: hilly large springs …", "aria-label": "Filter runs", value: view.text, autocomplete: "off",
    oninput: () => ((view.text = filter.value), draw()),
  });
  const states = ["", "running", "done", "interrupted", "failed", "problem"].map((name) =>
    h("option", { value: name, selected: view.status === name }, name || "all states"),
  );
  const status = h("select", { "aria-label": "State", onchange: () => ((view.status = status.value), draw()) }, states);
  const sorted = h("select", { class: "narrow", "aria-label": "Sort by", onchange: () => sort(sorted.value, true) },
    COLUMNS.map((column) => h("option", { value: column.name, selected: view.sort === column.name }, `by ${column.label}`)));
  const heads = COLUMNS.map((column) =>
    h("th", { scope: "col", class: column.number ? "number" : null },
      h("button", { type: "button", onclick: () => sort(column.name) }, column.label)));
  const body = h("tbody");
  const table = h("table", { class: "runs" }, h("thead", {}, h("tr", {}, h("th", { scope: "col", class: "choose" },
    h("span", { class: "hidden" }, "compare")), heads)), body);
  const rest = h("p", { class: "rest" });
  const bar = h("div", { class: "bar", role: "status", hidden: true });
  const chosen = new Set();
  let most = SHOWN, rows = new Map();

  element.append(
    h("div", { class: "head" }, h("h1", {}, store.folder || "runs"), summary),
    live.element, campaigns,
    h("div", { class: "tools" }, filter, status, sorted), table, rest, bar,
  );

  function sort(name, fresh = false) {
    const numeric = COLUMNS.find((column) => column.name === name).number && name !== "seed";
    view.down = view.sort === name && !fresh ? !view.down : Boolean(numeric);
    view.sort = name;
    draw();
  }

  function draw() {
    const all = [...store.runs.values()];
    const words = view.text.toLowerCase().split(/\s+/).filter(Boolean);
    const matches = (text) => words.every((word) => text.includes(word));
    const found = all.filter((run) => (!view.status || run.status === view.status) && matches(searched(run)));
    const broken = store.problems.filter(
      (one) => (!view.status || view.status === "problem") && matches(`${one.path} ${one.message} problem`.toLowerCase()));
    found.sort((a, b) => compared(a, b, view.sort) * (view.down ? -1 : 1) || (a.path < b.path ? -1 : 1));
    heads.forEach((head, k) => {
      if (COLUMNS[k].name === view.sort) head.setAttribute("aria-sort", view.down ? "descending" : "ascending");
      else head.removeAttribute("aria-sort");
    });
    fill(found.slice(0, most), broken);
    rest.replaceChildren();
    if (found.length > most) {
      rest.append(`${count(found.length - most)} more. `, h("button", { type: "button", onclick: () => ((most += 1000), draw()) }, "Show more"));
    } else if (!found.length && !broken.length) {
      rest.append(all.length || store.problems.length ? "Nothing matches the filter." : "No runs here yet. Start one: turgor evolve");
    }
    const running = all.filter((run) => run.status === "running").length;
    const notes = [`${count(all.length)} ${all.length === 1 ? "run" : "runs"}`];
    if (running) notes.push(`${running} running`);
    if (store.problems.length) notes.push(`${store.problems.length} with a problem`);
    if (found.length !== all.length) notes.push(`${count(found.length)} shown`);
    summary.textContent = notes.join(" · ");
    campaigns.replaceChildren(...store.campaigns.map(campaignCard));
    live.draw(all);
    showBar();
  }

  // Rows that did not change stay where they are, with the focus that they may have.
  function fill(runs, broken) {
    const fresh = new Map();
    const wanted = [
      ...broken.map((one) => [`! ${one.path}`, one.message, () => problemRow(one)]),
      ...runs.map((run) => [run.path, JSON.stringify(run) + ago(run.modified), () => runRow(run, chosen, showBar)]),
    ].map(([key, mark, make]) => {
      const old = rows.get(key);
      const row = old?.mark === mark ? old : { mark, element: make() };
      if (old && old !== row) old.element.replaceWith(row.element);
      fresh.set(key, row);
      return row.element;
    });
    rows = fresh;
    if (wanted.length !== body.children.length || wanted.some((row, k) => row !== body.children[k])) body.replaceChildren(...wanted);
  }

  function showBar() {
    for (const path of chosen) if (!store.runs.has(path)) chosen.delete(path);
    bar.hidden = chosen.size === 0;
    const [a, b] = [...chosen];
    const names = [...chosen].map((path) => title(store.runs.get(path)));
    bar.replaceChildren(
      h("span", {}, chosen.size === 1 ? `${names[0]}: choose another run to compare it with` : names.join("  against  ")),
      chosen.size === 2 ? h("a", { class: "button", href: compareHref(a, b) }, "Compare") : "",
      h("button", { type: "button", onclick: () => {
        chosen.clear();
        for (const box of body.querySelectorAll("input")) box.checked = false;
        showBar();
      } }, "Clear"),
    );
  }

  draw();
  store.addEventListener("library", draw);
  return () => {
    store.removeEventListener("library", draw);
    live.end();
  };
}

function runRow(run, chosen, changed) {
  const box = h("input", {
    type: "checkbox", "aria-label": `Compare ${title(run)}`, checked: chosen.has(run.path),
    onchange: () => {
      box.checked ? chosen.add(run.path) : chosen.delete(run.path);
      while (chosen.size > 2) {
        const [oldest] = chosen;
        chosen.delete(oldest);
        for (const other of box.closest("tbody").querySelectorAll("input")) if (other.value === oldest) other.checked = false;
      }
      changed();
    },
  });
  box.value = run.path;
  const cells = COLUMNS.map((column) =>
    h("td", { class: `${column.name}${column.number ? " number" : ""}`, "data-label": column.label }, column.cell(run)));
  return h("tr", { onclick: (event) => {
    if (!event.target.closest("a, input, label") && !getSelection().toString()) location.hash = runHref(run.path);
  } }, h("td", { class: "choose" }, h("label", {}, box)), cells);
}

function problemRow({ path, message }) {
  return h("tr", { class: "problem" }, h("td", { class: "choose" }), h("td", {}, badge("problem")),
    h("td", { colspan: COLUMNS.length - 1 }, h("b", {}, path || "this folder"), " ", message));
}

function taskCell(run) {
  return h("span", {}, h("a", { href: runHref(run.path), title: run.path || null }, run.name),
    run.change ? h("small", {}, run.change) : null);
}

function conditionCell(run) {
  return run.controller === "linear" ? run.condition : h("span", {}, run.condition, h("small", {}, run.controller));
}

function fitnessCell(run) {
  const solved = run.solved ? h("span", { class: "solved", title: "solved", role: "img", "aria-label": "solved" }, "✓") : null;
  return h("span", {}, solved, solved ? " " : null, h("b", {}, number(run.fitness)));
}

function progressCell(run) {
  if (run.status === "done") return count(run.evaluations);
  const share = Math.min(run.evaluations / Math.max(run.budget, 1), 1);
  return h("span", { class: "share" }, h("span", {}, `${Math.round(share * 100)} %`),
    h("progress", { max: 1, value: share, "aria-label": `${run.evaluations} of ${run.budget} evaluations` }));
}

function campaignCard(one) {
  const share = one.runs ? one.done / one.runs : 1;
  const state = one.runs ? `${one.done} of ${one.runs} runs done${one.running ? `, ${one.running} running` : ""}` : "tables";
  return h("a", { class: "card campaign", href: campaignHref(one.path) },
    h("b", {}, one.path || "This campaign"), h("span", { class: "muted" }, state),
    h("progress", { max: 1, value: share, "aria-label": state }), h("span", { class: "go" }, "Open the grid →"));
}

const searched = (run) =>
  `${run.path} ${run.name} ${run.body} ${run.condition} ${run.controller} ${run.strategy} ${run.change} ${run.status} s${run.seed}`.toLowerCase();

function compared(a, b, name) {
  const order = ORDER[name];
  const [x, y] = order ? [order.indexOf(a[name]), order.indexOf(b[name])] : [a[name], b[name]];
  if (x === y) return 0;
  if (x === null || y === null) return x === null ? -1 : 1;
  return x < y ? -1 : 1;
}

/** Cards of the runs that evolve now, with their curves. */
class Live {
  constructor(store) {
    this.store = store;
    this.element = h("section", { class: "live", "aria-label": "Evolving now", hidden: true });
    this.cards = new Map();
    this.rows = (event) => this.take(event.detail);
    store.addEventListener("rows", this.rows);
  }

  end() {
    this.store.removeEventListener("rows", this.rows);
    for (const card of this.cards.values()) card.curves.end();
  }

  draw(runs) {
    const running = runs.filter((run) => run.status === "running").sort((a, b) => b.modified - a.modified);
    const kept = running.filter((run) => this.cards.has(run.path));
    const wanted = [...kept, ...running.filter((run) => !this.cards.has(run.path))].slice(0, LIVE);
    for (const [path, card] of this.cards) {
      if (wanted.some((run) => run.path === path)) continue;
      card.curves.end();
      card.element.remove();
      this.cards.delete(path);
    }
    for (const run of wanted) {
      const card = this.cards.get(run.path) ?? this.make(run);
      card.value.textContent = `${number(run.fitness)} ${run.unit}`;
      card.share.value = run.evaluations / Math.max(run.budget, 1);
      card.note.textContent = `generation ${count(run.generation)} · ${count(run.evaluations)} of ${count(run.budget)}`;
    }
    this.element.hidden = this.cards.size === 0;
  }

  make(run) {
    const card = {
      value: h("b", {}), note: h("span", { class: "muted" }), plot: h("div"), history: null,
      share: h("progress", { max: 1, "aria-label": "evaluations done" }),
    };
    card.element = h("a", { class: "card", href: runHref(run.path) },
      h("span", { class: "line1" }, h("span", {}, title(run)), card.value), card.plot, card.share, card.note);
    card.history = new History({ generation: [], evaluations: [], best: [], median: [], sigma: [], seconds: [] });
    card.curves = new Curves(card.plot, [card.history], { compact: true });
    this.cards.set(run.path, card);
    this.element.append(card.element);
    this.load(run.path);
    return card;
  }

  async load(path) {
    const card = this.cards.get(path);
    try {
      card.history.columns = (await ask("run", path)).history;
      card.curves.draw();
    } catch {
      // it may be gone by now: the list tells
    }
  }

  take({ path, rows, first }) {
    const card = this.cards.get(path);
    if (!card) return;
    if (card.history.take(rows, first)) card.curves.draw();
    else this.load(path);
  }
}
