"""Evolution: strategies that propose controllers, and the loop that has them simulated.

`turgor.evolve` is the function of `turgor.evolve.loop`. Python puts this package under the same name as soon as
anything in it is imported, so the package can be called as well, and does the same.
"""

import sys
from types import ModuleType
from typing import Any


class _Package(ModuleType):
    def __call__(self, *args: Any, **options: Any) -> Any:
        from turgor.evolve.loop import evolve

        return evolve(*args, **options)


sys.modules[__name__].__class__ = _Package
