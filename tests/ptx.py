"""A machine for PTX on the CPU: what a GPU without its speed does. It translates a kernel to LLVM and runs its threads
one after the other, each operation as the PTX ISA defines it, so that compiled GPU code can be tried without a GPU.

It knows the instructions that the engine is made of, and refuses others.
"""

from __future__ import annotations

import ctypes
import re
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir

from turgor.physics import driver

I1, I8, I32, I64 = (ir.IntType(bits) for bits in (1, 8, 32, 64))
F32, F64 = ir.FloatType(), ir.DoubleType()
WORD = re.compile(r"[^\s,]+")
SPECIAL = ("%tid.x", "%ctaid.x", "%ntid.x")
OUT_OF_MEMORY, INVALID_PTX = 2, 218  # errors of the driver
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
        text = re.sub(r"//[^\n]*", "", ptx)
        entry = re.search(r"\.entry (\w+)\((.*?)\)\s*\.maxntid (\d+)[^{]*\{(.*)\}", text, re.DOTALL)
        self.name, head, most, body = entry.groups()
        self.most_threads = int(most)
        self._offsets, at = {}, 0
        for alignment, kind, name, length in re.findall(
            r"\.param (?:\.align (\d+) )?\.(\w+) (\w+)(?:\[(\d+)\])?", head
        ):
            size = SIZES[kind[1:]]
            at = -(-at // int(alignment or size)) * int(alignment or size)
            self._offsets[name] = at
            at += size * int(length or 1)
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
            elif text.startswith(".branchtargets"):
                self._targets = [self._blocks[label] for label in WORD.findall(text)[1:]]
            else:
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
        elif operation == "brx":  # to one of the targets listed just before
            self._branch_to_any(self._value(operands[0], I32))
        elif operation in ("ret", "exit"):
            self.builder.ret_void()
        elif operation == "ld" and kinds[1] == "v2":
            size = SIZES[kinds[2][1:]]
            for k, register in enumerate(operands[:2]):
                self._put(register.strip("{}"), self._load(kinds, f"{operands[2].strip('[]')}+{k * size}"))
        elif operation == "st":
            assert kinds[0] == "global"
            kind = type_of(kinds[-1])
            self.builder.store(self._value(operands[1], kind), self._address(operands[0], kind))
        else:
            self._put(operands[0], getattr(self, f"_{operation}")(kinds, operands[1:]))

    def _branch_to_any(self, number: ir.Value) -> None:
        here, beyond = self.builder, self.builder.append_basic_block()
        switch = here.switch(number, beyond)
        for k, target in enumerate(self._targets):
            switch.add_case(k, target)
        here.position_at_end(beyond)
        here.unreachable()

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
        base, *offsets = operand.strip("[]").split("+")
        start = self._parameter(base) if base in self._offsets else self._value(base, I64)
        return self.builder.inttoptr(self.builder.add(start, I64(sum(map(int, offsets)))), kind.as_pointer())

    def _parameter(self, name: str) -> ir.Value:
        """Where a parameter is."""
        return self.builder.add(self.builder.ptrtoint(self._arguments, I64), I64(self._offsets[name]))

    # --- instructions -----------------------------------------------------------------------------------------

    def _ld(self, kinds: list[str], operands: list[str]) -> ir.Value:
        return self._load(kinds, operands[0])

    def _load(self, kinds: list[str], operand: str) -> ir.Value:
        assert kinds[0] in ("param", "global")
        value = self.builder.load(self._address(operand, type_of(kinds[-1])))
        return self.builder.sext(value, I32) if kinds[-1] in ("s8", "s16") else value

    def _mov(self, kinds: list[str], operands: list[str]) -> ir.Value:
        return (
            self._parameter(operands[0]) if operands[0] in self._offsets else self._value(*operands, type_of(kinds[-1]))
        )

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

    def _mad(self, kinds: list[str], operands: list[str]) -> ir.Value:
        assert kinds[0] == "lo"
        product = self._arithmetic(kinds, operands[:2], "", "mul")
        return self.builder.add(product, self._value(operands[2], type_of(kinds[-1])))

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


class Driver:
    """NVIDIA's driver, as `turgor.physics.driver` calls it, of one such machine. Its memory is the CPU's."""

    def __init__(self, memory: int = 2**30) -> None:
        self.memory = memory  # [byte], that it says is free
        self._rooms: dict[int, np.ndarray] = {}
        for name, kinds in driver.FUNCTIONS.items():
            setattr(self, name, ctypes.CFUNCTYPE(ctypes.c_int, *kinds)(getattr(self, f"_{name}")))

    @property
    def used(self) -> int:
        """Memory that is in use [byte]."""
        return sum(room.nbytes for room in self._rooms.values())

    def _cuInit(self, flags: int) -> int:
        return 0

    def _cuGetErrorName(self, error: int, out: Any) -> int:
        out[0] = {OUT_OF_MEMORY: b"CUDA_ERROR_OUT_OF_MEMORY", INVALID_PTX: b"CUDA_ERROR_INVALID_PTX"}[error]
        return 0

    def _cuDeviceGet(self, out: Any, number: int) -> int:
        out[0] = number
        return 0

    def _cuDeviceGetName(self, out: int, size: int, device: int) -> int:
        name = b"a machine for PTX\0"
        assert len(name) <= size
        ctypes.memmove(out, name, len(name))
        return 0

    def _cuDevicePrimaryCtxRetain(self, out: Any, device: int) -> int:
        out[0] = 1
        return 0

    def _cuCtxSetCurrent(self, context: int) -> int:
        assert context == 1
        return 0

    def _cuCtxSynchronize(self) -> int:
        return 0

    def _cuModuleLoadDataEx(self, out: Any, text: bytes, count: int, options: Any, values: Any) -> int:
        assert [options[k] for k in range(count)] == [5, 6]  # of which the driver knows where errors are to be written
        if b".entry" not in text:
            ctypes.memmove(values[0], b"line 1: no entry\0", 17)
            return INVALID_PTX
        self.kernel = Kernel(text.decode())
        out[0] = 2
        return 0

    def _cuModuleGetFunction(self, out: Any, module: int, name: bytes) -> int:
        assert (module, name.decode()) == (2, self.kernel.name)
        out[0] = 3
        return 0

    def _cuMemGetInfo_v2(self, free: Any, total: Any) -> int:
        free[0] = total[0] = self.memory
        return 0

    def _cuMemAlloc_v2(self, out: Any, size: int) -> int:
        if size > self.memory:
            return OUT_OF_MEMORY
        room = np.full(size, 0xAB, np.uint8)
        self._rooms[room.ctypes.data] = room
        out[0] = room.ctypes.data
        return 0

    def _cuMemFree_v2(self, address: int) -> int:
        del self._rooms[address]
        return 0

    def _cuMemsetD8_v2(self, address: int, value: int, size: int) -> int:
        assert size == self._rooms[address].nbytes
        self._rooms[address][:] = value
        return 0

    def _cuMemcpyHtoD_v2(self, to: int, here: int, size: int) -> int:
        assert size == self._rooms[to].nbytes
        ctypes.memmove(to, here, size)
        return 0

    def _cuMemcpyDtoH_v2(self, to: int, here: int, size: int) -> int:
        assert size == self._rooms[here].nbytes
        ctypes.memmove(to, here, size)
        return 0

    def _cuLaunchKernel(self, function: int, *launch: Any) -> int:
        blocks, y, z, threads, below, behind, shared, stream, arguments, extra = launch
        assert (function, y, z, below, behind, shared, stream, bool(extra)) == (3, 1, 1, 1, 1, 0, None, False)
        assert threads <= self.kernel.most_threads
        self.kernel.run(ctypes.string_at(arguments[0], self.kernel.parameter_bytes), blocks, threads)
        return 0
