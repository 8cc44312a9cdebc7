"""From stages in Python to machine code: Numba types and translates every function, LLVM optimises all of them at once.

By itself Numba optimises each function alone, makes machine code of it, and does both again in whatever calls it. A
stage is only ever a part of the kernel, so that its translation is kept as it is until the kernel is whole. This file
stands on Numba's custom pipelines, and leaves those of Numba's steps out that stages have no use for (closures,
literals, array expressions, rewrites).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, ClassVar

import llvmlite.binding as llvm
from llvmlite import ir
from numba import njit, types
from numba.core import compiler, typed_passes, untyped_passes
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.cpu import _dynfunc
from numba.np.arrayobj import populate_array
from numba.np.numpy_support import from_dtype

from turgor.physics.engine import ENTRY, target_machine


class Part(JITCodeLibrary):
    """A translated function that waits for the whole."""

    def add_llvm_module(self, ll_module: Any) -> None:
        for function in ll_module.functions:
            if not function.is_declaration:
                function.linkage = "weak_odr"  # kept though nobody calls it yet; any number of equal copies are one
        self._final_module.link_in(ll_module)

    def finalize(self) -> None:
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """0: nobody calls a part."""
        return 0

    def _get_module_for_linking(self) -> Any:
        """The part with all that it calls."""
        if self._shared_module is None:
            whole = self._final_module.clone()
            for library in self._called():
                whole.link_in(library._final_module, preserve=True)
            for function in whole.functions:
                if not function.is_declaration:
                    function.linkage = "linkonce_odr"
            self._shared_module = whole
        return self._shared_module

    def _called(self) -> list[Any]:
        """All that the part calls, each once, callers first."""
        found: dict[Any, None] = {}
        waiting = list(self._linking_libraries)
        while waiting:
            library = waiting.pop(0)
            if library not in found:
                found[library] = None
                waiting += library._linking_libraries
        return list(found)


@register_pass(mutates_CFG=True, analysis_only=False)
class TranslatePart(typed_passes.NativeLowering):
    """Numba's translation to LLVM's language, without the machine code of each function."""

    _name = "translate_part"

    def run_pass(self, state: Any) -> bool:
        state.library = Part(state.targetctx.codegen(), state.func_id.func_qualname)
        super().run_pass(state)
        made = state["cr"]
        description = made.fndesc
        # by which Numba knows the function from now on; it cannot be called
        name = _dynfunc.make_function(
            description.lookup_module(), description.qualname, "", 0, made.env, (state.library,)
        )
        state.targetctx.insert_user_function(name, description, [state.library])
        state["cr"] = made._replace(cfunc=name)
        return True


class Remembered:
    """Numba's typing context, which is asked once what an operator gives for operands of some types."""

    _answers: ClassVar[dict[Any, Any]] = {}

    def __init__(self, context: Any) -> None:
        self._context = context

    def __getattr__(self, name: str) -> Any:
        return getattr(self._context, name)

    def resolve_function_type(self, function: Any, args: Any, kws: Any) -> Any:
        if type(function) is not types.Function or kws:
            return self._context.resolve_function_type(function, args, kws)
        _, answers = self._answers.setdefault(id(function), (function, {}))
        if args not in answers:
            answers[args] = self._context.resolve_function_type(function, args, kws)
        return answers[args]


class StageCompiler(compiler.CompilerBase):
    def __init__(self, typing_context: Any, *args: Any, **kwargs: Any) -> None:
        super().__init__(typing_context, *args, **kwargs)
        self.state.typingctx = Remembered(typing_context)
        self.state.flags.no_compile = True

    def define_pipelines(self) -> list[PassManager]:
        steps = PassManager("stage")
        for step, what in (
            (untyped_passes.TranslateByteCode, "analyzing bytecode"),
            (untyped_passes.FixupArgs, "fix up args"),
            (untyped_passes.IRProcessing, "processing IR"),
            (untyped_passes.ReconstructSSA, "ssa"),
            (typed_passes.NopythonTypeInference, "nopython frontend"),
            (typed_passes.PreLowerStripPhis, "remove phis nodes"),
            (TranslatePart, "translate to LLVM"),
            (typed_passes.NoPythonBackend, "nopython mode backend"),
        ):
            steps.add_pass(step, what)
        steps.finalize()
        return [steps]


# One of these above every function of the kernel. No fast-math: see lanes.py.
_options: dict[str, Any] = {
    "pipeline_class": StageCompiler,
    "error_model": "numpy",
    "boundscheck": False,
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
    "_nrt": False,
}
stage = njit(forceinline=True, **_options)
rare = njit(**_options)
inlined = stage
# Compiled once however many places call it: without the word, a function called from a stage is inlined like it.
shared = njit(forceinline=False, **_options)


def machine_code(kernel: Any, arguments: Sequence[Any]) -> bytes:
    """An object file with the function ENTRY(words), which calls the stage `kernel` with `arguments`: types, for arrays
    a pair (dtype, dimensions). What stands in `words` is told by `engine.words_of`."""
    return target_machine().emit_object(optimised(kernel, arguments))


def optimised(kernel: Any, arguments: Sequence[Any]) -> Any:
    """The kernel as one LLVM module, ready to be made machine code of."""
    wanted = tuple(types.Array(from_dtype(a[0]), a[1], "C") if isinstance(a, tuple) else a for a in arguments)
    kernel.compile(wanted)
    part = kernel.overloads[wanted]
    module = part.library._get_module_for_linking().clone()
    module.link_in(llvm.parse_assembly(str(_entry(part, wanted))))
    module.verify()
    for symbol in (*module.functions, *module.global_variables):
        if not symbol.is_declaration and symbol.name != ENTRY:
            symbol.linkage = "internal"
    machine = target_machine()
    module.data_layout = str(machine.target_data)
    # the lanes are the vectors, and their operations long enough without unrolling; level 3 is no faster
    options = llvm.create_pipeline_tuning_options(speed_level=2)
    options.loop_vectorization = options.slp_vectorization = False
    options.loop_interleaving = options.loop_unrolling = False
    passes = llvm.create_pass_builder(machine, options)
    passes.getModulePassManager().run(module, passes)
    for number, function in enumerate(module.functions):  # Numba counts in its names what a process has compiled
        if function.linkage == llvm.Linkage.internal:
            function.name = f"part{number}"
    return module


def _entry(part: Any, wanted: Sequence[types.Type]) -> ir.Module:
    """The function ENTRY."""
    context, description = part.target_context, part.fndesc
    module = context.codegen()._create_empty_module(ENTRY)
    word = ir.IntType(64)
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [word.as_pointer()]), ENTRY)
    builder = ir.IRBuilder(function.append_basic_block())
    at = itertools.count()

    def take() -> ir.Value:
        return builder.load(builder.gep(function.args[0], [word(next(at))]))

    values = []
    for kind in wanted:
        if isinstance(kind, types.Array):
            array = context.make_array(kind)(context, builder)
            data = builder.inttoptr(take(), array.data.type)
            shape = [take() for _ in range(kind.ndim)]
            size = context.get_abi_sizeof(context.get_data_type(kind.dtype))
            strides: list[ir.Value] = [word(size)]
            for length in reversed(shape[1:]):
                strides.insert(0, builder.mul(strides[0], length))
            populate_array(array, data, shape, strides, size, None)
            values.append(array._getvalue())
        else:
            values.append(take() if isinstance(kind, types.Integer) else context.get_dummy_value())
    callee = context.declare_function(module, description)
    context.call_conv.call_function(builder, callee, description.restype, description.argtypes, values)
    builder.ret_void()
    return module
