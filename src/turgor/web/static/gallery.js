// A gallery that stands alone: every replay small and in motion while it is in sight, and large in a dialog.

import { Camera, PALETTES, World, bodyScale, centreAt, drawBody } from "./draw.js";
import { bytesIn, switchTheme } from "./exported.js";
import { Player } from "./player.js";
import { loadReplay } from "./replay.js";

const LOOP = 10; // [s], what is seen small

/** A small picture in motion. Its replay is read when it is first in sight. */
class Small {
  constructor(card, replayOf) {
    this.canvas = card.querySelector("canvas");
    this.replayOf = replayOf;
    this.visible = false;
  }

  async show(visible) {
    this.visible = visible;
    if (visible && !this.replay) {
      this.replay = await this.replayOf();
      this.world ??= new World(this.replay.header.scene);
      this.draw(0);
    }
  }

  draw(now) {
    if (!this.replay || !this.canvas.clientWidth) return;
    const { replay, canvas } = this;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (canvas.width !== Math.round(width * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const context = canvas.getContext("2d", { alpha: false });
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    const t = ((now / 1000) % Math.min(LOOP, Math.max(replay.duration, 0.1))) / replay.dt;
    const [x, y] = centreAt(replay.path, t);
    const camera = new Camera(x, y, bodyScale(replay.header.extent, width, height), width, height);
    const root = document.documentElement.dataset.theme;
    const dark = root ? root === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
    const palette = PALETTES[dark ? "dark" : "light"];
    this.world.draw(context, camera, palette, { ruler: false });
    drawBody(context, replay, Math.min(t, replay.steps), camera, palette);
  }
}

/** Sets all cards of the page in motion. */
export function showGallery() {
  switchTheme(document.getElementById("theme"));
  const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const dialog = document.getElementById("large");
  const place = dialog.querySelector("div");
  const smalls = new Map();
  const seen = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) smalls.get(target).show(isIntersecting).catch(tell);
  });
  for (const card of document.querySelectorAll(".gallery-card")) {
    const read = cached(() => loadReplay(bytesIn(document.getElementById(card.dataset.replay))));
    smalls.set(card, new Small(card, read));
    seen.observe(card);
    card.addEventListener("click", async () => {
      const replay = await read();
      dialog.setAttribute("aria-label", replay.header.title);
      dialog.showModal();
      globalThis.player = new Player(place, [replay], { autoplay: true, loop: true, charts: window.innerHeight > 800 });
      globalThis.player.root.focus({ preventScroll: true }); // so that the space bar plays, and does not close
    });
  }
  dialog.querySelector("button").addEventListener("click", () => dialog.close());
  dialog.addEventListener("close", () => globalThis.player.destroy());
  const frame = (now) => {
    if (!dialog.open) for (const small of smalls.values()) if (small.visible) small.draw(still ? 0 : now);
    requestAnimationFrame(frame);
  };
  requestAnimationFrame(frame);
}

function cached(read) {
  let promise = null;
  return () => (promise ??= read());
}

function tell(error) {
  document.querySelector(".page-foot").textContent = `A replay cannot be shown: ${error.message}`;
}
