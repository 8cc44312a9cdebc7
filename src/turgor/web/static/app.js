// The page's frame: which view is shown, and what the server tells while it is.

import { ask, failure, h, style } from "./elements.js";
import { show as campaign } from "./campaign.js";
import { show as compare } from "./compare.js";
import { show as library } from "./library.js";
import { show as run } from "./run.js";

/** What is known of the folder; tells "library", "rows", "connection" as events. */
class Store extends EventTarget {
  folder = "";
  runs = new Map(); // path: summary
  campaigns = [];
  problems = [];
  ready = null; // promise of the first answer
  #source = null;
  #told = new Set();
  #frame = 0;

  constructor() {
    super();
    this.ready = this.refresh();
    this.listen();
    // A page in the background gives its connection back: browsers have six of them for all pages of a server.
    document.addEventListener("visibilitychange", () => (document.hidden ? this.#close() : this.listen()));
  }

  async refresh() {
    const found = await ask("library");
    this.folder = found.folder;
    this.campaigns = found.campaigns;
    this.problems = found.problems;
    this.runs = new Map(found.runs.map((summary) => [summary.path, summary]));
    this.#tell("library");
  }

  listen() {
    if (this.#source) return;
    const source = (this.#source = new EventSource("api/events"));
    let lost = false;
    source.onopen = () => {
      this.dispatchEvent(new CustomEvent("connection", { detail: true }));
      if (lost || this.#told.has("closed")) {
        this.#told.clear();
        this.refresh().catch(() => {});
        this.dispatchEvent(new CustomEvent("anew"));
      }
      lost = false;
    };
    source.onerror = () => {
      lost = true;
      this.dispatchEvent(new CustomEvent("connection", { detail: false }));
      if (source.readyState === EventSource.CLOSED && this.#source === source) {
        this.#close();
        setTimeout(() => document.hidden || this.listen(), 3000);
      }
    };
    source.addEventListener("run", (event) => {
      const summary = JSON.parse(event.data);
      this.runs.set(summary.path, summary);
      this.#tell("library");
    });
    source.addEventListener("gone", (event) => {
      this.runs.delete(JSON.parse(event.data).path);
      this.#tell("library");
    });
    source.addEventListener("library", () => this.refresh().catch(() => {}));
    source.addEventListener("rows", (event) => {
      this.dispatchEvent(new CustomEvent("rows", { detail: JSON.parse(event.data) }));
    });
  }

  #close() {
    this.#source?.close();
    this.#source = null;
    this.#told.add("closed");
  }

  #tell(kind) {
    // Many changes at once are one picture.
    cancelAnimationFrame(this.#frame);
    this.#frame = requestAnimationFrame(() => this.dispatchEvent(new CustomEvent(kind)));
  }
}

const store = new Store();
const main = document.querySelector("main");
const VIEWS = { "": library, run, campaign, compare, play };
let leave = null; // ends the view that is shown

async function route() {
  leave?.();
  leave = null;
  const element = h("div", { class: "view" });
  main.replaceChildren(element);
  window.scrollTo(0, 0);
  for (const link of document.querySelectorAll("nav a")) {
    const here = link.hash === (location.hash.startsWith("#/play") ? "#/play" : "#/");
    here ? link.setAttribute("aria-current", "page") : link.removeAttribute("aria-current");
  }
  try {
    const [name = "", ...parts] = location.hash.replace(/^#\/?/, "").split("/").map(decodeURIComponent);
    const view = Object.hasOwn(VIEWS, name) ? VIEWS[name] : null;
    if (view === null) throw new Error("There is no such page.");
    document.title = "turgor";
    const end = view(element, store, ...parts);
    leave = () => end?.();
  } catch (error) {
    element.append(failure(error instanceof URIError ? "There is no such page." : error.message));
  }
}

/** The playground, whose code is loaded when it is first wanted. */
function play(element) {
  let player = null, over = false;
  style("static/play.css");
  document.title = "playground · turgor";
  const url = new URL("api/play", document.baseURI);
  url.protocol = url.protocol.replace("http", "ws");
  url.hash = "";
  import("./play.js")
    .then(({ start }) => {
      if (!over) player = start(element, url.href);
    })
    .catch((error) => element.append(failure(`The playground cannot be shown: ${error.message}`)));
  return () => {
    over = true;
    player?.stop();
  };
}

// --- frame -----------------------------------------------------------------------------------------------------------

const dark = window.matchMedia("(prefers-color-scheme: dark)");

function paintTheme() {
  const chosen = localStorage.getItem("turgor-theme");
  if (chosen) document.documentElement.dataset.theme = chosen;
  const isDark = chosen ? chosen === "dark" : dark.matches;
  document.querySelector(".theme").textContent = isDark ? "☀" : "☾";
  return isDark;
}

document.querySelector(".theme").addEventListener("click", () => {
  localStorage.setItem("turgor-theme", paintTheme() ? "light" : "dark");
  paintTheme();
});
dark.addEventListener("change", paintTheme);
paintTheme();

store.addEventListener("connection", (event) => {
  document.querySelector(".connection").hidden = event.detail;
});
if (location.search) history.replaceState(null, "", location.pathname + location.hash); // the token stays private
window.addEventListener("hashchange", () => location.hash === "#main" || route());
store.ready.then(route, (error) => main.replaceChildren(failure(error.message)));
