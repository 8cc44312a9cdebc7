// The player, whose code is loaded when there is something to play.

import { ask, failure, h, style } from "./elements.js";

/** Plays the replays of `wanted`, each {path, which}, in `element`; returns what ends it. */
export function showReplays(element, wanted) {
  let player = null, over = false;
  const stage = h("div", { class: "stage" });
  element.replaceChildren(h("p", { class: "muted", role: "status" }, "Simulating the champion …"));

  async function play() {
    const [{ Player }, { loadReplay }, ...data] = await Promise.all([
      code("./player.js"), code("./replay.js"), ...wanted.map(({ path, which }) => ask("replay", path, `?which=${which}`)),
    ]);
    const replays = await Promise.all(data.map((one) => loadReplay(one)));
    if (over) return;
    element.replaceChildren(stage);
    player = new Player(stage, replays, {});
  }

  play().catch((error) => over || element.replaceChildren(failure(`It cannot be played: ${error.message}`)));
  return () => {
    over = true;
    player?.destroy();
  };
}

async function code(module) {
  style("static/player.css");
  try {
    return await import(module);
  } catch {
    throw new Error(`the page's part ${module.slice(2)} is missing.`);
  }
}
