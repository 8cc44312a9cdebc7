"""Pages that stand alone: one or two replays in a player, or a gallery of many, in a single HTML file.

Such a file needs no server, no network and no other file: styles, modules and replays lie in it, and its
Content-Security-Policy allows nothing else to run or to be fetched.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Callable, Iterable, Sequence
from html import escape
from itertools import groupby
from pathlib import Path
from typing import Any

from turgor.errors import InvalidInput
from turgor.runs import Run
from turgor.web.replay import Header, read_header, replay_of_run

STATIC = Path(__file__).with_name("static")
EVERY = 2  # steps: of a gallery's replays one in two is kept, 30 frames/s
IMPORT = re.compile(r'^import \{([^}]*)\} from "\./(\w+\.js)";\n', re.MULTILINE)
EXPORT = re.compile(r"^export (?=(?:async function|function|class|const) (\w+))", re.MULTILINE)


# --- modules ------------------------------------------------------------------------------------------------------


def inlined(module: str, call: str, folder: Path = STATIC) -> str:
    """The text of one script that is the file `module` with all that it imports, and calls its function `call`.

    Pages from a disk cannot import files. Each module becomes a function that returns what it exports, in the order
    in which they need each other. Only `import { a, b } from "./file.js";` and `export` before a function, a class
    or a const are known; anything else raises `InvalidInput`.
    """
    parts: dict[str, str] = {}

    def add(name: str) -> None:
        if name in parts:
            return
        text = (folder / name).read_text(encoding="utf-8")
        parts[name] = ""  # on its way; a circle would find it so
        for _, other in IMPORT.findall(text):
            add(other)
            if not parts[other]:
                raise InvalidInput(f"{name}: expected modules that do not import each other in a circle", other)
        body = IMPORT.sub(lambda found: f"const {{{found[1]}}} = {_variable(found[2])};\n", text)
        names = EXPORT.findall(body)
        body = EXPORT.sub("", body)
        left = re.search(r"^\s*(?:import\b|export\b).*|^.*\bimport\(.*", body, re.MULTILINE)
        if left:
            raise InvalidInput(f"{name}: expected plain imports and exports", left[0].strip())
        if "</script" in body.lower() or "<!--" in body:
            raise InvalidInput(f"{name}: expected a module that can stand in HTML", "</script or <!--")
        del parts[name]  # it stands after what it needs
        parts[name] = f"const {_variable(name)} = (() => {{\n{body}return {{ {', '.join(names)} }};\n}})();\n"

    add(module)
    return '"use strict";\n' + "".join(parts.values()) + f"{_variable(module)}.{call}();\n"


def _variable(name: str) -> str:
    return "module_" + name.removesuffix(".js")


# --- pages --------------------------------------------------------------------------------------------------------


def export_replays(replays: Sequence[bytes], title: str | None = None) -> str:
    """The HTML of a page that plays one replay, or two side by side. Raises `InvalidInput`."""
    if not 1 <= len(replays) <= 2:
        raise InvalidInput("replays: expected one or two", str(len(replays)))
    headers = [read_header(replay) for replay in replays]
    heading = title or " and ".join(header.title for header in headers)
    first = headers[0]
    about = "; ".join(f"{'AB'[k]}: {told_fitness(h)}" for k, h in enumerate(headers)).removeprefix(
        "A: " if len(headers) == 1 else ""
    )
    about += f"; {first.steps * first.dt:g} s at {1 / first.dt:.0f} steps/s"
    body = '<main id="place"></main>\n' + "".join(_data_block(k, replay) for k, replay in enumerate(replays))
    return _page(heading, about, body, inlined("exported.js", "showReplays"))


def export_gallery(replays: Iterable[bytes], title: str = "Gallery", note: str = "") -> str:
    """The HTML of a page with all `replays` in groups of one task and body: small in motion, large on a click."""
    found = sorted(((read_header(replay), replay) for replay in replays), key=lambda pair: _order(pair[0]))
    cards, blocks = "", ""
    for place, ((task, size), members) in enumerate(groupby(found, key=lambda pair: (pair[0].name, pair[0].body))):
        group = list(members)
        cards += (
            f'<section aria-labelledby="group-{place}">\n<h2 class="gallery-group" id="group-{place}">'
            f"{escape(task)}, {escape(size)} <span>{len(group)}</span></h2>\n"
        )
        cards += '<div class="gallery">\n'
        for header, replay in group:
            k = blocks.count("</script>")
            name = f"{header.condition}, {header.controller}" if header.controller != "linear" else header.condition
            short = f"{name}, seed {header.seed}"
            cards += (
                f'<button class="gallery-card" type="button" data-replay="replay-{k}" '
                f'aria-label="{escape(f"Open {header.title}: {told_fitness(header)}")}">\n'
                f'<canvas aria-hidden="true"></canvas>\n'
                f"<span>{escape(short)} <strong>{escape(told_fitness(header, short=True))}</strong></span>\n</button>\n"
            )
            blocks += _data_block(k, replay)
        cards += "</div>\n</section>\n"
    large = '<dialog class="gallery-large" id="large"><button type="button">Close</button><div></div></dialog>\n'
    rate = 1 / (found[0][0].dt) if found else 30
    about = f"{len(found)} champions, {rate:.0f} frames/s. Small pictures loop the first 10 s; click one for all of it."
    about += f" {note}" if note else ""
    return _page(title, about, f"<main>\n{cards}</main>\n{large}{blocks}", inlined("gallery.js", "showGallery"))


def _order(header: Header) -> tuple[Any, ...]:
    sizes = ("small", "medium", "large")
    size = sizes.index(header.body) if header.body in sizes else len(sizes)
    fitness = header.fitness if header.fitness is not None else float("-inf")
    return header.name, size, header.body, header.condition, -fitness


def told_fitness(header: Header, short: bool = False) -> str:
    """The fitness in words, with what it is from moved starts."""
    if header.fitness is None:
        return "" if short else "no fitness"
    text = f"{header.fitness:.2f}{header.unit}"
    if short:
        return text.replace("-", "−")
    if header.robust is not None:
        text += f", {header.robust:.2f}{header.unit} from moved starts"
    return (text + ", solved" * header.solved).replace("-", "−")


def _data_block(k: int, replay: bytes) -> str:
    """A script element that no browser runs."""
    data = base64.b64encode(replay).decode()
    return f'<script type="application/octet-stream" class="replay" id="replay-{k}">{data}</script>\n'


def _page(title: str, about: str, body: str, script: str) -> str:
    from turgor import __version__

    style = "".join((STATIC / name).read_text(encoding="utf-8") for name in ("style.css", "player.css"))
    script, style = f"\n{script}", f"\n{style}"
    allowed = {
        "default-src": "'none'",
        "script-src": _digest(script),
        "style-src": _digest(style),
        "img-src": "data:",  # the empty icon, in place of one that would be asked for
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    policy = "; ".join(f"{name} {value}" for name, value in allowed.items())
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<link rel="icon" href="data:,">
<style>{style}</style>
</head>
<body>
<div class="page">
<header class="page-head"><div><h1>{escape(title)}</h1><p>{escape(about)}</p></div>
<button type="button" id="theme" aria-label="Dark or light">◐</button></header>
{body}<footer class="page-foot">Made with turgor {escape(__version__)}: pressure-based soft agents. \
This file holds all that it shows and fetches nothing.</footer>
</div>
<script type="module">{script}</script>
</body>
</html>
"""


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


# --- runs ---------------------------------------------------------------------------------------------------------


def export_runs(paths: Sequence[Path], which: str = "best") -> str:
    """The page of the champions of one run, or of two side by side. Raises `InvalidInput`."""
    if not 1 <= len(paths) <= 2:
        raise InvalidInput("export: expected one run, or two side by side", str(len(paths)))
    return export_replays([replay_of_run(path, which) for path in paths])


def export_folder(
    folder: Path, which: str = "best", progress: Callable[[int, int], object] | None = None
) -> tuple[str, list[str]]:
    """The gallery of the champions of all runs below `folder`, and a line for each run that has none to show.

    `progress(done, total)` is called after each run. Raises `InvalidInput` where no run is found, or none that can
    be shown.
    """
    if not folder.is_dir():
        raise InvalidInput(f"{folder}: expected a folder of runs", "a file" if folder.exists() else "nothing there")
    paths = sorted(path.parent for path in folder.rglob("run.json"))
    if not paths:
        raise InvalidInput(f"{folder}: expected a folder with runs below it", "none")
    replays, problems = [], []
    for k, path in enumerate(paths):
        try:
            replays.append(replay_of_run(path, which, every=_every(path)))
        except InvalidInput as problem:
            problems.append(str(problem))
        if progress is not None:
            progress(k + 1, len(paths))
    if not replays:
        raise InvalidInput(f"{folder}: expected runs with a champion", problems[0])
    note = f"{len(problems)} of {len(paths)} runs have none to show." if problems else ""
    return export_gallery(replays, f"Champions of {folder.resolve().name}", note), problems


def _every(path: Path) -> int:
    """So that short steps are thinned out, and long ones kept."""
    return EVERY if Run.open(path).task.physics.dt < 1 / 40 else 1
