"""A machine for PTX on the CPU: what a GPU without its speed does. It translates a kernel to LLVM and runs its threads
one after the other, each operation as the PTX ISA defines it, so that compiled GPU code can be tried without a GPU.

It knows the instructions that the engine is made of, and refuses others.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Sequence

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir

I1, I8, I32, I64 = (ir.IntType(bits) for bits in (1, 8, 32, 64))
F32, F64 = ir.FloatType(), ir.DoubleType()
WORD = re.compile(r"[^\s,]+")
SPECIAL = ("%tid.x", "%ctaid.x", "%ntid.x")
SIZES = {"8": 1, "16": 2, "32": 4, "64": 8}
ORDERED = {"eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">="}
UNORDERED = {"equ": "==", "neu": "!=", "ltu": "<", "leu": "<=", "gtu": ">", "geu": ">="}


def type_of(kind: str) -> ir.Type:
    """The LLVM type of a PTX type: s32, u64, b16, f32, pred ..."""
    if kind == "pred":
        return I1
    if kind[0] == "f":
        return F32 if kind == "f32" else F64
    return ir.IntType(int(kind[1:]))


class Kernel:
    """The one kernel of a PTX text, compiled for this processor."""

    def __init__(self, ptx: str) -> None:
        head, body = re.search(r"\.entry \w+\((.*?)\)(?:\s*\.\w+[^{]*)?\{(.*)\}", ptx, re.DOTALL).groups()
        self.parameters = re.findall(r"\.param \.(\w+) (\w+)", head)  # type and name, in order
        self._offsets, at = {}, 0
        for kind, name in self.parameters:
            size = SIZES[kind[1:]]
            at = -(-at // size) * size
            self._offsets[name] = at, kind
            at += size
        self.parameter_bytes = at
        self.instructions = [text.strip() for text in body.replace(":", ":;").split(";") if text.strip()]
        self._translate()
        self._compile()

    def run(self, arguments: bytes, blocks: int, threads: int) -> None:
        """Every thread of a grid."""
        assert len(arguments) == self.parameter_bytes
        for block in range(blocks):
            for thread in range(threads):
                self._function(arguments, thread, block, threads)

    # --- translation ------------------------------------------------------------------------------------------

    def _translate(self) -> None:
        self.module = ir.Module()
        function = ir.Function(self.module, ir.FunctionType(ir.VoidType(), [I8.as_pointer(), I32, I32, I32]), "kernel")
        self._arguments = function.args[0]
        self._specials = dict(zip(SPECIAL, function.args[1:], strict=True))
        self._registers: dict[str, ir.Value] = {}
        start = function.append_basic_block("start")
        labels = {text[:-1] for text in self.instructions if text.endswith(":")}
        self._blocks = {label: function.append_basic_block(label) for label in sorted(labels)}
        self.builder = ir.IRBuilder(function.append_basic_block("first"))
        self._start = ir.IRBuilder(start)
        first = self.builder.block
        for text in self.instructions:
            if text.endswith(":"):
                self._go(self._blocks[text[:-1]])
            elif text.startswith(".reg"):
                self._declare(text)
            elif not text.startswith((".loc", "{", "}", ".pragma")):
                self._instruction(function, text)
        self._start.branch(first)

    def _go(self, block: ir.Block) -> None:
        if not self.builder.block.is_terminated:
            self.builder.branch(block)
        self.builder.position_at_end(block)

    def _declare(self, text: str) -> None:
        kind, prefix, count = re.fullmatch(r"\.reg \.(\w+)\s+(%\w+?)<(\d+)>", text).groups()
        for number in range(int(count)):
            self._registers[f"{prefix}{number}"] = self._start.alloca(type_of(kind))

    def _instruction(self, function: ir.Function, text: str) -> None:
        guard = re.match(r"@(!?)(%\w+)\s+", text)
        if guard is None:
            return self._do(text)
        condition = self.builder.load(self._registers[guard[2]])
        if guard[1]:
            condition = self.builder.not_(condition)
        then, after = (function.append_basic_block() for _ in range(2))
        self.builder.cbranch(condition, then, after)
        self.builder.position_at_end(then)
        self._do(text[guard.end() :])
        self._go(after)
        return None

    def _do(self, text: str) -> None:
        name, rest = (text.split(None, 1) + [""])[:2]
        operation, *kinds = name.split(".")
        operands = WORD.findall(rest)
        if operation == "bra":
            self.builder.branch(self._blocks[operands[0]])
        elif operation == "ret":
            self.builder.ret_void()
        elif operation == "st":
            assert kinds[0] == "global"
            kind = type_of(kinds[-1])
            self.builder.store(self._value(operands[1], kind), self._address(operands[0], kind))
        else:
            self._put(operands[0], getattr(self, f"_{operation}")(kinds, operands[1:]))

    def _put(self, register: str, value: ir.Value) -> None:
        place = self._registers[register]
        kind = place.type.pointee
        if value.type != kind:
            if isinstance(value.type, ir.IntType) and isinstance(kind, ir.IntType):
                value = (
                    self.builder.zext(value, kind) if value.type.width < kind.width else self.builder.trunc(value, kind)
                )
            else:
                value = self.builder.bitcast(value, kind)
        self.builder.store(value, place)

    def _value(self, operand: str, kind: ir.Type) -> ir.Value:
        if operand in self._specials:
            return self._specials[operand]
        if operand.startswith("%"):
            value = self.builder.load(self._registers[operand])
            if value.type == kind:
                return value
            if isinstance(kind, ir.IntType) and isinstance(value.type, ir.IntType):
                return (
                    self.builder.trunc(value, kind) if kind.width < value.type.width else self.builder.zext(value, kind)
                )
            return self.builder.bitcast(value, kind)
        if operand.startswith("0f"):
            return self.builder.bitcast(I32(int(operand[2:], 16)), F32)
        if operand.startswith("0d"):
            return self.builder.bitcast(I64(int(operand[2:], 16)), F64)
        return kind(int(operand, 0))

    def _address(self, operand: str, kind: ir.Type) -> ir.Value:
        base, _, offset = operand.strip("[]").partition("+")
        address = self.builder.add(self._value(base, I64), I64(int(offset or 0)))
        return self.builder.inttoptr(address, kind.as_pointer())

    # --- instructions -----------------------------------------------------------------------------------------

    def _ld(self, kinds: list[str], operands: list[str]) -> ir.Value:
        kind = type_of(kinds[-1])
        if kinds[0] == "param":
            at, declared = self._offsets[operands[0].strip("[]")]
            assert SIZES[declared[1:]] == SIZES[kinds[-1][1:]]
            place = self.builder.gep(self._arguments, [I32(at)])
            return self.builder.load(self.builder.bitcast(place, kind.as_pointer()))
        assert kinds[0] == "global"
        value = self.builder.load(self._address(operands[0], kind))
        return self.builder.sext(value, I32) if kinds[-1] in ("s8", "s16") else value

    def _mov(self, kinds: list[str], operands: list[str]) -> ir.Value:
        return self._value(operands[0], type_of(kinds[-1]))

    def _cvta(self, kinds: list[str], operands: list[str]) -> ir.Value:
        assert kinds == ["to", "global", "u64"]
        return self._value(operands[0], I64)

    def _cvt(self, kinds: list[str], operands: list[str]) -> ir.Value:
        given, wanted = kinds[-1], kinds[-2]
        value, target = self._value(operands[0], type_of(given)), type_of(wanted)
        if given[0] == "f":
            assert wanted[0] == "f"  # to whole numbers: not needed so far
            assert kinds[0] == "rn" or target == F64
            return self.builder.fptrunc(value, target) if target == F32 else self.builder.fpext(value, target)
        if wanted[0] == "f":
            assert kinds[0] == "rn"
            return self.builder.sitofp(value, target) if given[0] == "s" else self.builder.uitofp(value, target)
        if target.width <= value.type.width:
            return self.builder.trunc(value, target) if target.width < value.type.width else value
        return self.builder.sext(value, target) if given[0] == "s" else self.builder.zext(value, target)

    def _arithmetic(self, kinds: list[str], operands: list[str], for_float: str, for_int: str) -> ir.Value:
        kind = type_of(kinds[-1])
        values = [self._value(operand, kind) for operand in operands]
        if kinds[-1][0] != "f":
            return getattr(self.builder, for_int)(*values)
        assert kinds[0] == "rn"  # rounded by itself: without the word, the assembler may fuse it with others
        assert len(kinds) == 2  # neither flushed to zero nor saturated
        return getattr(self.builder, for_float)(*values)

    def _add(self, kinds: list[str], operands: list[str]) -> ir.Value:
        return self._arithmetic(kinds, operands, "fadd", "add")

    def _sub(self, kinds: list[str], operands: list[str]) -> ir.Value:
        return self._arithmetic(kinds, operands, "fsub", "sub")

    def _mul(self, kinds: list[str], operands: list[str]) -> ir.Value:
        if kinds[0] != "wide":
            assert kinds[0] in ("rn", "lo")
            return self._arithmetic(kinds, operands, "fmul", "mul")
        narrow, wide = type_of(kinds[1]), ir.IntType(2 * type_of(kinds[1]).width)
        widen = self.builder.sext if kinds[1][0] == "s" else self.builder.zext
        a, b = (widen(self._value(operand, narrow), wide) for operand in operands)
        return self.builder.mul(a, b)

    def _div(self, kinds: list[str], operands: list[str]) -> ir.Value:
        return self._arithmetic(kinds, operands, "fdiv", "sdiv" if kinds[-1][0] == "s" else "udiv")

    def _rem(self, kinds: list[str], operands: list[str]) -> ir.Value:
        return self._arithmetic(kinds, operands, "frem", "srem" if kinds[-1][0] == "s" else "urem")

    def _rcp(self, kinds: list[str], operands: list[str]) -> ir.Value:
        assert kinds[0] == "rn"
        kind = type_of(kinds[-1])
        return self.builder.fdiv(kind(1.0), self._value(operands[0], kind))

    def _sqrt(self, kinds: list[str], operands: list[str]) -> ir.Value:
        assert kinds == ["rn", "f32"]
        function = self.module.declare_intrinsic("llvm.sqrt", [F32])
        return self.builder.call(function, [self._value(operands[0], F32)])

    def _neg(self, kinds: list[str], operands: list[str]) -> ir.Value:
        value = self._value(operands[0], type_of(kinds[-1]))
        return self.builder.fneg(value) if kinds[-1][0] == "f" else self.builder.neg(value)

    def _abs(self, kinds: list[str], operands: list[str]) -> ir.Value:
        assert kinds == ["f32"]
        return self.builder.and_(self._value(operands[0], I32), I32(0x7FFFFFFF))

    def _min(self, kinds: list[str], operands: list[str]) -> ir.Value:
        return self._extreme(kinds, operands, "<")

    def _max(self, kinds: list[str], operands: list[str]) -> ir.Value:
        return self._extreme(kinds, operands, ">")

    def _extreme(self, kinds: list[str], operands: list[str], symbol: str) -> ir.Value:
        kind, build = type_of(kinds[-1]), self.builder
        a, b = (self._value(operand, kind) for operand in operands)
        if kinds[-1][0] != "f":
            compare = build.icmp_signed if kinds[-1][0] == "s" else build.icmp_unsigned
            return build.select(compare(symbol, a, b), a, b)
        assert kinds == ["f32"]
        # "+0.0 > -0.0", and the other operand where one is NaN
        bits = [build.bitcast(value, I32) for value in (a, b)]
        same = build.bitcast((build.or_ if symbol == "<" else build.and_)(*bits), F32)
        ordered = build.select(
            build.fcmp_ordered(symbol, a, b), a, build.select(build.fcmp_ordered("==", a, b), same, b)
        )
        return build.select(
            build.fcmp_unordered("uno", a, a), b, build.select(build.fcmp_unordered("uno", b, b), a, ordered)
        )

    def _setp(self, kinds: list[str], operands: list[str]) -> ir.Value:
        comparison, kind = kinds
        a, b = (self._value(operand, type_of(kind)) for operand in operands)
        if kind[0] == "f":
            if comparison in ("num", "nan"):
                return (self.builder.fcmp_ordered if comparison == "num" else self.builder.fcmp_unordered)(
                    "ord" if comparison == "num" else "uno", a, b
                )
            if comparison in ORDERED:
                return self.builder.fcmp_ordered(ORDERED[comparison], a, b)
            return self.builder.fcmp_unordered(UNORDERED[comparison], a, b)
        compare = self.builder.icmp_signed if kind[0] == "s" else self.builder.icmp_unsigned
        return compare(ORDERED[comparison], a, b)

    def _selp(self, kinds: list[str], operands: list[str]) -> ir.Value:
        a, b = (self._value(operand, type_of(kinds[-1])) for operand in operands[:2])
        return self.builder.select(self._value(operands[2], I1), a, b)

    def _bits(self, kinds: list[str], operands: list[str], operation: str) -> ir.Value:
        return getattr(self.builder, operation)(*(self._value(operand, type_of(kinds[-1])) for operand in operands))

    def _and(self, kinds: list[str], operands: list[str]) -> ir.Value:
        return self._bits(kinds, operands, "and_")

    def _or(self, kinds: list[str], operands: list[str]) -> ir.Value:
        return self._bits(kinds, operands, "or_")

    def _xor(self, kinds: list[str], operands: list[str]) -> ir.Value:
        return self._bits(kinds, operands, "xor")

    def _not(self, kinds: list[str], operands: list[str]) -> ir.Value:
        return self._bits(kinds, operands, "not_")

    def _shl(self, kinds: list[str], operands: list[str]) -> ir.Value:
        return self._shift(kinds, operands, "shl")

    def _shr(self, kinds: list[str], operands: list[str]) -> ir.Value:
        return self._shift(kinds, operands, "ashr" if kinds[-1][0] == "s" else "lshr")

    def _shift(self, kinds: list[str], operands: list[str], operation: str) -> ir.Value:
        kind = type_of(kinds[-1])
        assert 0 <= int(operands[1], 0) < kind.width
        return getattr(self.builder, operation)(self._value(operands[0], kind), kind(int(operands[1], 0)))

    def _bfi(self, kinds: list[str], operands: list[str]) -> ir.Value:
        kind = type_of(kinds[-1])
        field, base = (self._value(operand, kind) for operand in operands[:2])
        at, count = (int(operand, 0) for operand in operands[2:])
        mask = ((1 << count) - 1) << at
        inserted = self.builder.and_(self.builder.shl(field, kind(at)), kind(mask))
        return self.builder.or_(inserted, self.builder.and_(base, kind(~mask & (2**kind.width - 1))))

    # --- compilation ------------------------------------------------------------------------------------------

    def _compile(self) -> None:
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        machine = llvm.Target.from_default_triple().create_target_machine(opt=1)
        parsed = llvm.parse_assembly(str(self.module))
        parsed.verify()
        passes = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=1))
        passes.getModulePassManager().run(parsed, passes)
        self._engine = llvm.create_mcjit_compiler(parsed, machine)
        self._engine.finalize_object()
        address = self._engine.get_function_address("kernel")
        self._function = ctypes.CFUNCTYPE(None, ctypes.c_char_p, *[ctypes.c_int32] * 3)(address)


class Memory:
    """An array of the machine."""

    def __init__(self, array: np.ndarray) -> None:
        self.array = array
        self.shape, self.itemsize, self.size, self.nbytes = array.shape, array.itemsize, array.size, array.nbytes
        self.address = array.ctypes.data if array.size else 0


class Machine:
    """What `turgor.physics.driver.Device` does, for a kernel that runs here."""

    name = "a machine for PTX"

    def __init__(self, compute_capability: tuple[int, int]) -> None:
        self.compute_capability = compute_capability
        self.launches = 0

    def load(self, ptx: str) -> None:
        self.kernel = Kernel(ptx)

    def free_bytes(self) -> int:
        return 2**30

    def zeros(self, shape: Sequence[int], itemsize: int = 4) -> Memory:
        assert itemsize == 4
        return Memory(np.zeros(shape, np.float32))

    def upload(self, array: np.ndarray) -> Memory:
        return Memory(array.copy())

    def download(self, memory: Memory, array: np.ndarray) -> None:
        array[...] = memory.array

    def launch(self, grid: int, block: int, arguments: Sequence[tuple[type, float]]) -> None:
        assert len(arguments) == len(self.kernel.parameters)
        packed = bytearray()
        for (kind, value), (declared, _) in zip(arguments, self.kernel.parameters, strict=True):
            assert ctypes.sizeof(kind) == SIZES[declared[1:]]
            assert (kind is ctypes.c_float) == (declared[0] == "f")
            packed += bytes(-len(packed) % ctypes.sizeof(kind)) + bytes(kind(value))
        self.kernel.run(bytes(packed), grid, block)
        self.launches += 1
