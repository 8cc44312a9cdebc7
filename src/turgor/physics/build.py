"""From stages in Python to machine code: Numba types and translates every function, LLVM optimises all of them at once.

By itself Numba optimises each function alone, makes machine code of it, and does both again in whatever calls it. A
stage is only ever a part of the kernel, so that its translation is kept as it is until the kernel is whole. This file
stands on Numba's custom pipelines, and leaves those of Numba's steps out that stages have no use for (closures,
literals, array expressions, rewrites).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import llvmlite.binding as llvm
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils, compiler, typed_passes, untyped_passes
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.cpu import _dynfunc
from numba.np.arrayobj import populate_array
from numba.np.numpy_support import from_dtype

from turgor.errors import InvalidInput
from turgor.physics.engine import ENTRY, THREADS, target_machine, words_in

WORD = ir.IntType(64)
THREAD = "thread"  # an argument: its number
GPU = "nvptx64-nvidia-cuda"
OLDEST_GPU = "sm_70"  # of 2017
GLOBAL = 1  # the space of addresses where a GPU's memory is
BLOCKS = 4  # of THREADS at once on a multiprocessor: at most 128 registers a thread


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
    a pair (dtype, dimensions), or (dtype, shape) for one that lies in the words. What else stands there is told by
    `engine.words_of`."""
    return target_machine().emit_object(optimised(kernel, arguments))


def optimised(kernel: Any, arguments: Sequence[Any], machine: Any = None) -> Any:
    """The kernel as one LLVM module, ready to be made machine code of for this processor or another `machine`."""
    machine = machine or target_machine()
    on_gpu = machine.triple == GPU
    wanted = tuple(map(_numba_type, arguments))
    kernel.compile(wanted)
    part = kernel.overloads[wanted]
    module = part.library._get_module_for_linking().clone()
    module.link_in(llvm.parse_assembly(str(_entry(part, arguments, on_gpu))))
    module.verify()
    for symbol in (*module.functions, *module.global_variables):
        if not symbol.is_declaration and symbol.name != ENTRY:
            symbol.linkage = "internal"
            if on_gpu and symbol.is_function:
                symbol.add_function_attribute("alwaysinline")
    module.triple = machine.triple
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


def _numba_type(argument: Any) -> types.Type:
    if argument == THREAD:
        return types.int64
    if not isinstance(argument, tuple):
        return argument
    dtype, shape = argument
    return types.Array(from_dtype(dtype), shape if isinstance(shape, int) else len(shape), "C")


def _entry(part: Any, arguments: Sequence[Any], on_gpu: bool) -> ir.Module:
    """The function ENTRY."""
    context, description = part.target_context, part.fndesc
    module = context.codegen()._create_empty_module(ENTRY)
    argument_type = ir.ArrayType(WORD, 0) if on_gpu else WORD
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [argument_type.as_pointer()]), ENTRY)
    builder = ir.IRBuilder(function.append_basic_block())
    words = builder.bitcast(function.args[0], WORD.as_pointer())
    taken = 0

    def take(count: int = 1) -> ir.Value:
        nonlocal taken
        taken += count
        return builder.gep(words, [WORD(taken - count)])

    values = []
    for argument in arguments:
        kind = _numba_type(argument)
        if isinstance(kind, types.Array):
            values.append(_array(context, builder, kind, argument[1], take, on_gpu))
        elif argument == THREAD and on_gpu:
            values.append(_thread_number(builder))
        elif isinstance(kind, types.Integer):
            values.append(builder.load(take()))
        else:
            values.append(context.get_dummy_value())
    if on_gpu:
        _make_gpu_kernel(function, taken)
    callee = context.declare_function(module, description)
    context.call_conv.call_function(builder, callee, description.restype, description.argtypes, values)
    builder.ret_void()
    return module


def _array(context: Any, builder: Any, kind: Any, shape: Any, take: Callable[..., ir.Value], on_gpu: bool) -> ir.Value:
    """An array as Numba has it, from words: its address and shape, or all of it where its `shape` is given."""
    array = context.make_array(kind)(context, builder)
    size = context.get_abi_sizeof(context.get_data_type(kind.dtype))
    if isinstance(shape, int):
        address = builder.load(take())
        lengths = [builder.load(take()) for _ in range(shape)]
        data = builder.inttoptr(address, array.data.type.pointee.as_pointer(GLOBAL if on_gpu else 0))
        data = builder.addrspacecast(data, array.data.type) if on_gpu else data
    else:
        lengths = [WORD(length) for length in shape]
        data = builder.bitcast(take(words_in(shape, size)), array.data.type)
    strides: list[ir.Value] = [WORD(size)]
    for length in reversed(lengths[1:]):
        strides.insert(0, builder.mul(strides[0], length))
    populate_array(array, data, lengths, strides, size, None)
    return array._getvalue()


# --- on a GPU -----------------------------------------------------------------------------------------------------


def ptx(kernel: Any, arguments: Sequence[Any], architecture: str = OLDEST_GPU) -> str:
    """The same as `machine_code` for NVIDIA GPUs of an `architecture` or newer: text that their driver makes machine
    code of. The words themselves are what the kernel is launched with; a THREAD is the thread's number. Raises
    `InvalidInput` where llvmlite was built without such GPUs."""
    machine = _gpu_machine(architecture)
    return machine.emit_assembly(optimised(kernel, arguments, machine))


def _gpu_machine(architecture: str) -> Any:
    """LLVM's description of a GPU. Every operation is rounded as IEEE 754 has it, one by one, as by default."""
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    try:
        target = llvm.Target.from_triple(GPU)
    except RuntimeError as error:
        raise InvalidInput("device: expected an llvmlite that knows NVIDIA's GPUs, as on PyPI", str(error)) from None
    return target.create_target_machine(cpu=architecture, opt=3)


def _make_gpu_kernel(function: ir.Function, words: int) -> None:
    """Says that GPUs launch it, that `words` are its argument, and for how many threads it is."""
    function.calling_convention = "ptx_kernel"
    function.args[0].type = ir.ArrayType(WORD, words).as_pointer()
    function.args[0].add_attribute("byval")
    number = ir.IntType(32)
    bounds = [function, "maxntidx", number(THREADS), "minctasm", number(BLOCKS)]
    function.module.add_named_metadata("nvvm.annotations", function.module.add_metadata(bounds))


def _thread_number(builder: ir.IRBuilder) -> ir.Value:
    """The number of this thread among all."""

    def ask(name: str) -> ir.Value:
        kind = ir.FunctionType(ir.IntType(32), [])
        asked = cgutils.get_or_insert_function(builder.module, kind, f"llvm.nvvm.read.ptx.sreg.{name}.x")
        return builder.zext(builder.call(asked, []), WORD)

    return builder.add(builder.mul(ask("ctaid"), WORD(THREADS)), ask("tid"))
