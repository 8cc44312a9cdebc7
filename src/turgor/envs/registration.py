"""The environments' names in Gymnasium: `import turgor` registers them, before or after `import gymnasium`."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from importlib.machinery import ModuleSpec
    from types import ModuleType

ENVIRONMENTS = {
    "turgor/Hilly-v0": "hilly",
    "turgor/Flat-v0": "flat",
    "turgor/Escape-v0": "escape",
    "turgor/Inflate-v0": "inflate",
}


def register() -> None:
    """Registers what is not yet registered. How long an episode is depends on `steps`: the environments end their
    episodes themselves and fill in `spec.max_episode_steps`, so that `make` need not wrap them in a TimeLimit."""
    from gymnasium.envs import registration

    for name, task in ENVIRONMENTS.items():
        if name not in registration.registry:
            registration.register(
                name,
                entry_point="turgor.envs.scalar:Env",
                vector_entry_point="turgor.envs.vector:VectorEnv",
                kwargs={"task": task},
            )


def register_on_import() -> None:
    """Registers now if Gymnasium is there, otherwise as soon as it is imported: turgor alone does not wait for it.

    Since its version 1.0 Gymnasium does not look for the environments of other packages by itself.
    """
    if "gymnasium" in sys.modules:
        register()
    elif not any(isinstance(finder, _WithGymnasium) for finder in sys.meta_path):
        sys.meta_path.insert(0, _WithGymnasium())


# A finder and a loader by their methods alone: `importlib.abc` takes as long to import as the rest of turgor.


class _WithGymnasium:
    """Leaves finding Gymnasium to the other finders; calls `register` after its import."""

    def find_spec(self, fullname: str, path: Any, target: ModuleType | None = None) -> ModuleSpec | None:
        if fullname != "gymnasium":
            return None
        others = [finder.find_spec for finder in sys.meta_path if finder is not self and hasattr(finder, "find_spec")]
        spec = next((found for find in others if (found := find(fullname, path, target))), None)
        if spec is not None and spec.loader is not None:
            spec.loader = _Registering(spec.loader)  # ty: ignore[invalid-assignment]
        return spec


class _Registering:
    """Puts the module's own loader back, lets it load, and calls `register`."""

    def __init__(self, loader: Any) -> None:
        self.loader = loader

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self.loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        module.__loader__ = self.loader
        if module.__spec__ is not None:
            module.__spec__.loader = self.loader
        self.loader.exec_module(module)
        register()
