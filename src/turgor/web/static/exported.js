// A page that stands alone: the replays that lie in it, in one player.

import { Player } from "./player.js";
import { loadReplay } from "./replay.js";

/** The bytes of a data block of the page. */
export function bytesIn(element) {
  return Uint8Array.from(atob(element.textContent.trim()), (letter) => letter.charCodeAt(0));
}

/** Lets a button switch between dark and light. */
export function switchTheme(button) {
  const root = document.documentElement;
  button.addEventListener("click", () => {
    const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
    root.dataset.theme = dark ? "light" : "dark";
  });
}

/** The page's player, once it can play. */
export async function showReplays() {
  switchTheme(document.getElementById("theme"));
  const place = document.getElementById("place");
  try {
    const replays = await Promise.all([...document.querySelectorAll("script.replay")].map((s) => loadReplay(bytesIn(s))));
    globalThis.player = new Player(place, replays, { autoplay: true, loop: true, title: document.title });
  } catch (error) {
    place.className = "page-problem";
    place.textContent = `This replay cannot be shown: ${error.message}`;
  }
}
