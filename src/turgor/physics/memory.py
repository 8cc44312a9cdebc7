"""Memory for lanes: views into one aligned buffer per block, laid out from the annotations of a NamedTuple.

    class State(NamedTuple):
        x: Annotated[Floats, "mass"]    # [m]

`views(State, buffer, offsets, width)` makes a State whose fields are bare pointers, without reference counts or bounds
checks: to rows (x[i] is row i in all lanes, x[i, lane] one number) or tables (x[i] is one number that all lanes share).
"""

from __future__ import annotations

import operator
from collections.abc import Mapping
from functools import cache
from typing import Any, get_args, get_type_hints

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.extending import NativeValue, lower_builtin, models, register_model, typeof_impl, unbox
from numba.core.typing.templates import AbstractTemplate, infer_global, signature

from turgor.errors import InvalidInput
from turgor.physics.lanes import ELEMENT, SCALAR, Lanes, as_lanes, intrinsic

MOST_BYTES = 256_000_000  # of one piece of memory; what would take more is refused
MOST_TRACE_BYTES = 4_000_000_000  # the same of a recording, which grows with the steps
LINE = 64  # [byte], a cache line and the widest vector
BYTES = 4  # of a float32 and an int32


class Width(int):
    """The number of lanes as an argument of a kernel. It is part of the argument's type, and so are `build` and
    `stride`: how many agents stand side by side in memory, one value of lanes after the other; None for `width`.

    Numba's disk cache knows a compiled kernel by its argument types alone, and sees neither a changed global
    nor a changed function in another file: a different `width` or `build` makes it compile anew.
    """

    build: str
    stride: int

    def __new__(cls, width: int, build: str = "", stride: int | None = None) -> Width:
        self = super().__new__(cls, width)
        self.build = build
        self.stride = stride or width
        return self


class WidthType(types.Type):
    def __init__(self, width: int, build: str, stride: int) -> None:
        self.width, self.build, self.stride = width, build, stride
        super().__init__(f"Width({width}, {build}, {stride})")


@typeof_impl.register(Width)
def _type_of_width(value: Width, context: Any) -> WidthType:
    return WidthType(int(value), value.build, value.stride)


@register_model(WidthType)
class _WidthModel(models.OpaqueModel):
    pass


@unbox(WidthType)
def _unbox_width(typ: Any, value: Any, context: Any) -> NativeValue:
    return NativeValue(context.context.get_dummy_value())


@intrinsic
def lane_count(typingctx: Any, width: Any) -> Any:
    """The number of lanes as an int."""

    def emit(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        return ir.Constant(ir.IntType(64), width.width)

    return types.intp(width), emit


@intrinsic
def agents_abreast(typingctx: Any, width: Any) -> Any:
    """How many agents stand side by side in memory, as an int."""

    def emit(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        return ir.Constant(ir.IntType(64), width.stride)

    return types.intp(width), emit


class View(types.Type):
    """A pointer to numbers of one kind: rows of `width` lanes, or (width None) one number each. From one to the next
    it is `stride` numbers."""

    def __init__(self, kind: str, width: int | None, stride: int) -> None:
        self.kind, self.width, self.stride = kind, width, stride
        self.element = SCALAR[kind]
        self.row = self.element if width is None else Lanes(kind, width)
        super().__init__(f"view({kind}, {width}, {stride})")


@register_model(View)
class _ViewModel(models.PrimitiveModel):
    def __init__(self, manager: Any, view: View) -> None:
        super().__init__(manager, view, ELEMENT[view.kind].as_pointer())


_PAIR = types.UniTuple(types.intp, 2)


@infer_global(operator.getitem)
class _Get(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:
        view, index = args
        if isinstance(view, View) and isinstance(index, types.Integer):
            return signature(view.row, view, types.intp)
        if isinstance(view, View) and view.width is not None and isinstance(index, types.BaseTuple):
            return signature(view.element, view, _PAIR)
        return None


@infer_global(operator.setitem)
class _Set(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:
        view, index, _ = args
        if isinstance(view, View) and isinstance(index, types.Integer):
            return signature(types.none, view, types.intp, view.row)
        if isinstance(view, View) and view.width is not None and isinstance(index, types.BaseTuple):
            return signature(types.none, view, _PAIR, view.element)
        return None


def _row_pointer(builder: Any, view: View, pointer: Any, index: Any) -> Any:
    if view.stride != 1:
        index = builder.mul(index, index.type(view.stride))
    first = builder.gep(pointer, [index])
    return first if view.width is None else builder.bitcast(first, Lanes(view.kind, view.width).llvm.as_pointer())


def _number_pointer(builder: Any, view: View, pointer: Any, index: Any) -> Any:
    row, lane = cgutils.unpack_tuple(builder, index)
    return builder.gep(pointer, [builder.add(builder.mul(row, row.type(view.stride)), lane)])


def _alignment(view: View) -> int:
    return min(LINE, BYTES * (view.width or 1))


@lower_builtin(operator.getitem, View, types.Integer)
def _get_row(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.load(_row_pointer(builder, sig.args[0], *args), align=_alignment(sig.args[0]))


@lower_builtin(operator.getitem, View, types.BaseTuple)
def _get_number(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.load(_number_pointer(builder, sig.args[0], *args))


@lower_builtin(operator.setitem, View, types.Integer, types.Any)
def _set_row(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    builder.store(args[2], _row_pointer(builder, sig.args[0], *args[:2]), align=_alignment(sig.args[0]))
    return context.get_dummy_value()


@lower_builtin(operator.setitem, View, types.BaseTuple, types.Any)
def _set_number(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    builder.store(args[2], _number_pointer(builder, sig.args[0], *args[:2]))
    return context.get_dummy_value()


@intrinsic
def fill(typingctx: Any, view: Any, value: Any) -> Any:
    """`value` in every lane, as a value of the rows of `view`."""

    def emit(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        return as_lanes(context, builder, values[1], value, view.row)

    return view.row(view, value), emit


# Annotations of the fields of a NamedTuple of views.


class Floats:
    """Rows of float32, one number a lane."""


class Ints:
    """Rows of int32, one number a lane."""


class FloatTable:
    """float32 numbers that all lanes share."""


class IntTable:
    """int32 numbers that all lanes share."""


FIELD: dict[Any, tuple[str, bool]] = {
    Floats: ("float", True),
    Ints: ("int", True),
    FloatTable: ("float", False),
    IntTable: ("int", False),
}


def check_memory(expected: str, size: int, most: int = MOST_BYTES) -> None:
    """Raises `InvalidInput` where `size` bytes are more than a single piece of memory may have."""
    if size > most:
        raise InvalidInput(f"{expected}, in at most {most / 1e6:.0f} MB", f"{size / 1e6:.0f} MB")


@cache
def fields(views: type) -> dict[str, tuple[type, str]]:
    """{field: (annotation, name of its length)} of a NamedTuple of views."""
    hints = get_type_hints(views, include_extras=True)
    return {name: get_args(hints[name]) for name in views._fields}  # ty: ignore[missing-attribute]


def layout(views: type, lengths: Mapping[str, int], width: int, lanes: int | None = None) -> np.ndarray:
    """Offsets of the fields in a buffer of float32 [4 byte], and at the end its size; each on a cache line.

    Rows are `width` agents wide. A number of a table is shared by as many as are `lanes` of one value, None for all.
    """
    tables = max(1, width // (lanes or width))
    offsets, at = [], 0
    for annotation, length in fields(views).values():
        offsets.append(at)
        size = lengths[length] * (width if FIELD[annotation][1] else tables)
        at += -(-size // (LINE // BYTES)) * (LINE // BYTES)
    return np.array([*offsets, at], dtype=np.int64)


def aligned(count: int, size: int) -> np.ndarray:
    """Zeros, float32 [count, size], each row on a cache line; `size` as given by `layout`."""
    raw = np.zeros(count * size * BYTES + LINE, dtype=np.uint8)
    start = -raw.ctypes.data % LINE
    return raw[start : start + count * size * BYTES].view(np.float32).reshape(count, size)


def field_of(
    buffer: np.ndarray, views: type, offsets: np.ndarray, name: str, lengths: Mapping[str, int], width: int
) -> np.ndarray:
    """A field of one `buffer` [size] as a writable array: [length, width] for rows, [length] for tables."""
    annotation, length = fields(views)[name]
    kind, in_lanes = FIELD[annotation]
    at = offsets[list(fields(views)).index(name)]
    flat = buffer[at : at + lengths[length] * (width if in_lanes else 1)]
    flat = flat.view(np.int32) if kind == "int" else flat
    return flat.reshape(-1, width) if in_lanes else flat


@intrinsic
def views(typingctx: Any, cls: Any, buffer: Any, offsets: Any, width: Any) -> Any:
    """A NamedTuple `cls` of views into the float32 array `buffer` [size], at `offsets` (see `layout`): of all lanes of
    a block, or of tables that all blocks share."""
    made = [
        View(kind, width.width, width.width) if in_lanes else View(kind, None, 1) for kind, in_lanes in _kinds_of(cls)
    ]
    result = _tuple_of(cls, made)

    def emit(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        zero = ir.IntType(64)(0)
        return context.make_tuple(builder, result, _pointers(context, builder, sig, values, made, zero))

    return result(cls, buffer, offsets, width), emit


@intrinsic
def lane_views(typingctx: Any, cls: Any, buffer: Any, offsets: Any, width: Any, lane: Any) -> Any:
    """The same of one lane alone, in a block of `width.stride` agents: what the lanes of `views` share is its own."""
    made = [View(kind, 1 if in_lanes else None, width.stride) for kind, in_lanes in _kinds_of(cls)]
    result = _tuple_of(cls, made)

    def emit(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        first = context.cast(builder, values[4], lane, types.int64)
        return context.make_tuple(builder, result, _pointers(context, builder, sig, values, made, first))

    return result(cls, buffer, offsets, width, lane), emit


def _kinds_of(cls: Any) -> list[tuple[str, bool]]:
    return [FIELD[annotation] for annotation, _ in fields(cls.instance_class).values()]


def _tuple_of(cls: Any, made: list[View]) -> types.Type:
    if len(set(made)) == 1:
        return types.NamedUniTuple(made[0], len(made), cls.instance_class)
    return types.NamedTuple(made, cls.instance_class)


def _pointers(context: Any, builder: Any, sig: Any, values: Any, made: list[View], first: Any) -> list[ir.Value]:
    """Where each field begins, `first` numbers behind the block's own beginning."""
    _, buffer, offsets, *_ = sig.args
    data = cgutils.create_struct_proxy(buffer)(context, builder, values[1]).data
    pointers = []
    for k, view in enumerate(made):
        if isinstance(offsets, types.BaseTuple):  # numbers of the call, not of the memory
            offset = context.cast(builder, builder.extract_value(values[2], k), offsets[k], types.int64)
        else:
            at = cgutils.create_struct_proxy(offsets)(context, builder, values[2]).data
            offset = builder.load(builder.gep(at, [ir.IntType(64)(k)]))
        place = builder.gep(data, [builder.add(offset, first)])
        pointers.append(builder.bitcast(place, ELEMENT[view.kind].as_pointer()))
    return pointers
