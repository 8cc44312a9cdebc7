"""The machine code and its file: what is made, when, and what a start from the file does without."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import llvmlite.binding as llvm
import pytest

from turgor.errors import InvalidInput
from turgor.physics import engine
from turgor.physics.build import Part, optimised
from turgor.physics.engine import ENTRY
from turgor.physics.step import ARGUMENTS, run_blocks

SOURCES = Path(engine.__file__).parent
NOTICE = "turgor: compiling the engine"
FIRST_ROLLOUT = """
import sys, numpy, turgor
task = turgor.make_task(steps=50)
print(turgor.Simulator(task).rollout(numpy.zeros((1, task.parameter_count))).position.tobytes().hex())
print(*sys.modules)
"""


def start(cache: Path) -> tuple[str, set[str], bool]:
    """A process that does one rollout: its bits, the modules that it loaded, whether it had to compile."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    done = subprocess.run([sys.executable, "-c", FIRST_ROLLOUT], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    bits, modules = done.stdout.splitlines()
    return bits, set(modules.split()), NOTICE in done.stderr


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the file, as this process makes it or has it; `engine` looks elsewhere for its own."""
    folder = tmp_path_factory.mktemp("kept")
    with pytest.MonkeyPatch.context() as patch:
        engine.load()
        code = engine._found() or engine._made()
        patch.setattr(engine, "_folders", lambda: [folder])
        engine._keep(code)
    return folder


def test_a_start_from_the_file_needs_neither_numba_nor_scipy(kept: Path) -> None:
    bits, modules, compiled = start(kept)
    assert not compiled
    assert not {"numba", "scipy", "matplotlib", "cma", "turgor.physics.build", "turgor.physics.step"} & modules
    assert len(modules) < 400  # with Numba and what it loads: 760
    assert len(bits) > 100


def test_a_torn_file_is_made_anew(kept: Path, tmp_path: Path) -> None:
    (file,) = kept.iterdir()
    whole = file.read_bytes()
    torn = tmp_path / file.name
    torn.write_bytes(whole[: len(whole) // 2])
    bits, modules, compiled = start(tmp_path)
    assert compiled
    assert "numba" in modules
    assert torn.read_bytes() == whole  # the same machine code, bit for bit
    assert [path.name for path in tmp_path.iterdir()] == [file.name]
    assert start(tmp_path)[::2] == start(kept)[::2] == (bits, False)


def test_no_folder_to_write_to(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    _, _, compiled = start(tmp_path / "file" / "below")
    assert compiled


def test_without_the_variable_the_file_is_beside_the_sources_or_among_the_users_caches(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert engine._folders() == [SOURCES / "__pycache__", tmp_path / "turgor"]
    # what stands in the way of the first is no harm to the second
    (tmp_path / "file").touch()
    monkeypatch.setattr(engine, "_sources", tmp_path / "file")
    assert engine._found() is None
    engine._keep(b"machine code")
    assert engine._found() == b"machine code"
    assert [path.parent for path in tmp_path.rglob("kernel-*")] == [tmp_path / "turgor"]


NAME = "from turgor.physics import engine; print(engine._name())"


def test_another_numba_is_named_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    optimised(run_blocks, ARGUMENTS)  # Numba itself asks for it when it first translates
    monkeypatch.delattr(llvm, "create_pipeline_tuning_options")  # llvmlite 0.43, which comes with Numba 0.60, has none
    with pytest.raises(AttributeError):  # not Numba's fault
        engine._made()
    monkeypatch.setattr("importlib.metadata.version", lambda name: {"numba": "0.60.0"}[name])
    with pytest.raises(InvalidInput, match=r"^expected numba<0.69,>=0.61 to .*; got numba 0.60.0: module 'llvmlite"):
        engine._made()


def test_a_numba_that_cannot_be_imported_is_named_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "turgor.physics.build", None)  # as with a NumPy that Numba does not know
    with pytest.raises(InvalidInput, match=r"^expected numba<0.69,>=0.61 to .*; got numba 0\.\d+\.\d+: .*halted"):
        engine._made()


def test_generic_machine_code_uses_no_feature_of_this_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NUMBA_CPU_FEATURES", raising=False)
    monkeypatch.setenv("NUMBA_CPU_NAME", "generic")
    assert engine.processor() == ("generic", "")


def test_another_processor_or_an_edited_source_has_another_file(tmp_path: Path) -> None:
    shutil.copytree(SOURCES.parent, tmp_path / "turgor", ignore=shutil.ignore_patterns("__pycache__"))

    def name(**environment: str) -> tuple[str, ...]:
        known = {**os.environ, "PYTHONPATH": str(tmp_path), **environment}
        out = subprocess.check_output([sys.executable, "-c", NAME], env=known, text=True)
        return tuple(out.strip().split("-"))

    _, place, sources = name()
    _, elsewhere, same = name(NUMBA_CPU_NAME="nocona", NUMBA_CPU_FEATURES="+sse2")
    assert elsewhere != place
    assert same == sources
    with (tmp_path / "turgor" / "physics" / "springs.py").open("a") as file:
        file.write("# edited\n")
    _, here, edited = name()
    assert here == place
    assert edited != sources


def test_the_file_of_older_sources_goes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    names = {"kernel-here-old", "kernel-here-new", "kernel-elsewhere-old"}
    for name in sorted(names - {"kernel-here-new"}):
        (tmp_path / name).touch()
    monkeypatch.setattr(engine, "_name", lambda kind: "kernel-here-new")
    engine._keep(b"machine code")
    assert {path.name for path in tmp_path.iterdir()} == names - {"kernel-here-old"}


def test_what_cannot_be_removed_stays(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    (first / "kernel-here-a folder").mkdir(parents=True)  # to `unlink` as a file is that another process has open
    monkeypatch.setattr(engine, "_folders", lambda: [first, second])
    monkeypatch.setattr(engine, "_name", lambda kind: "kernel-here-new")
    engine._keep(b"machine code")
    assert {path.name for path in first.iterdir()} == {"kernel-here-a folder", "kernel-here-new"}
    assert not second.exists()


def test_the_whole_kernel_is_optimised_at_once_and_needs_nothing_from_outside() -> None:
    module = optimised(run_blocks, ARGUMENTS)
    defined = {function.name for function in module.functions if not function.is_declaration}
    outside = {function.name for function in module.functions if function.is_declaration}
    assert ENTRY in defined
    assert len(defined) <= 5  # what is called from several places, or rarely; the rest has become part of them
    # each is a few instructions on every processor, but memset, which every system's C library has
    known = {"cttz", "fabs", "lifetime", "memset", "smax", "smin", "sqrt"}
    assert {name.removeprefix("llvm.").partition(".")[0] for name in outside} <= known
    # neither addresses of this process nor room for it to write
    assert not re.search(r"inttoptr \(i64 \d", str(module))
    assert not [name.name for name in module.global_variables if not name.is_global_constant()]


def test_every_stage_is_translated_once() -> None:
    """Numba translates a function again for other types of arguments, a literal among them. Only its own min and max of
    whole numbers are made machine code of by themselves."""
    optimised(run_blocks, ARGUMENTS)
    (kernel,) = run_blocks.overloads.values()
    called = kernel.library._called()
    stages = [library.name for library in called if isinstance(library, Part)]
    assert len(stages) <= 75
    twice = {name for name in stages if stages.count(name) > 1}
    assert twice <= {"record", "first_column", "push", "clamp", "pick", "forget", "clip"}
    assert {library.name.partition(".")[0] for library in called if not isinstance(library, Part)} <= {
        *("nrt", "ol_min", "ol_max")
    }
