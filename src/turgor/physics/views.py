"""Memory as compiled code sees it: bare pointers, without reference counts or bounds checks.

`views(State, buffer, offsets, width)` has a field for each of State: rows (x[i] is row i in all lanes, x[i, lane] one
number) or tables (x[i] is one number that all lanes share). `numbers(Settings, buffer)` has one number a field.

Both are as small as what they are made from, so that it costs the compiler little to hand them from function to
function: a field is looked up where it is used, and LLVM moves that out of the loops, because it is told that offsets
and settings never change.
"""

from __future__ import annotations

import operator
from typing import Any, get_type_hints

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.extending import NativeValue, lower_builtin, models, register_model, typeof_impl, unbox
from numba.core.imputils import lower_getattr_generic
from numba.core.typing.templates import AbstractTemplate, AttributeTemplate, infer_getattr, infer_global, signature

from turgor.physics.lanes import ELEMENT, SCALAR, Lanes, as_lanes, intrinsic
from turgor.physics.memory import BYTES, FIELD, LINE, fields


class Width(int):
    """The number of lanes as an argument of compiled code: it is part of the argument's type."""


class WidthType(types.Type):
    """`width` lanes; `abreast` agents stand side by side in memory, by default as many."""

    def __init__(self, width: int, abreast: int | None = None) -> None:
        self.width, self.abreast = width, abreast or width
        super().__init__(f"Width({self.width}, {self.abreast})")


@typeof_impl.register(Width)
def _type_of_width(value: Width, context: Any) -> WidthType:
    return WidthType(int(value))


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
        return ir.Constant(ir.IntType(64), width.abreast)

    return types.intp(width), emit


# --- one field ----------------------------------------------------------------------------------------------------


class View(types.Type):
    """A pointer to numbers of one kind: rows of `width` lanes, or (width None) one number each. From one to the next it
    is `stride` numbers."""

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
    if view.stride > 1:
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


# --- all fields of a block ----------------------------------------------------------------------------------------


def _unchanging(builder: Any, load: Any) -> Any:
    """`load` marked as one of memory that never changes."""
    load.set_metadata("invariant.load", builder.module.add_metadata([]))
    return load


class Views(types.Type):
    """The fields of a NamedTuple of views: where the numbers lie, and the offset of each field."""

    def __init__(self, cls: type, width: int, row: int, number: int) -> None:
        """Rows of `width` lanes are `row` numbers apart, those of tables `number`."""
        self.views = {
            name: View(FIELD[annotation][0], *((width, row) if FIELD[annotation][1] else (None, number)))
            for name, (annotation, _) in fields(cls).items()
        }
        super().__init__(f"{cls.__name__}({width}, {row}, {number})")


@register_model(Views)
class _ViewsModel(models.StructModel):
    def __init__(self, manager: Any, views: Views) -> None:
        members = [("numbers", types.CPointer(types.float32)), ("offsets", types.CPointer(types.int64))]
        super().__init__(manager, views, members)


@infer_getattr
class _FieldOfViews(AttributeTemplate):
    key = Views

    def generic_resolve(self, views: Views, name: str) -> View | None:
        return views.views.get(name)


@lower_getattr_generic(Views)
def _field_of_views(context: Any, builder: Any, views: Views, value: Any, name: str) -> Any:
    at = ir.IntType(64)(list(views.views).index(name))
    offset = _unchanging(builder, builder.load(builder.gep(builder.extract_value(value, 1), [at])))
    first = builder.gep(builder.extract_value(value, 0), [offset])
    return builder.bitcast(first, ELEMENT[views.views[name].kind].as_pointer())


@intrinsic
def views(typingctx: Any, cls: Any, buffer: Any, offsets: Any, width: Any) -> Any:
    """The fields of a NamedTuple `cls` of views into the float32 array `buffer` [size], at `offsets` (see `layout`): of
    all lanes of a block, or of tables that all blocks share."""
    result = Views(cls.instance_class, width.width, width.width, 1)

    def emit(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        return _made(context, builder, sig, values)._getvalue()

    return result(cls, buffer, offsets, width), emit


@intrinsic
def lane_views(typingctx: Any, cls: Any, buffer: Any, offsets: Any, width: Any, lane: Any) -> Any:
    """The same of one `lane` alone among all that stand side by side: tables of the block's are its own."""
    result = Views(cls.instance_class, 1, width.abreast, width.abreast)

    def emit(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        made = _made(context, builder, sig, values)
        made.numbers = builder.gep(made.numbers, [values[4]])
        return made._getvalue()

    return result(cls, buffer, offsets, width, types.int64), emit


def _made(context: Any, builder: Any, sig: Any, values: Any) -> Any:
    made = cgutils.create_struct_proxy(sig.return_type)(context, builder)
    made.numbers = cgutils.create_struct_proxy(sig.args[1])(context, builder, values[1]).data
    made.offsets = cgutils.create_struct_proxy(sig.args[2])(context, builder, values[2]).data
    return made


# --- single numbers -----------------------------------------------------------------------------------------------


class Numbers(types.Type):
    """The fields of a NamedTuple of numbers, int32 or float32."""

    def __init__(self, cls: type) -> None:
        hints = get_type_hints(cls)
        self.kinds = {name: "float" if hint is np.float32 else "int" for name, hint in hints.items()}
        super().__init__(f"numbers({cls.__name__})")


@register_model(Numbers)
class _NumbersModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numbers: Numbers) -> None:
        super().__init__(manager, numbers, ir.FloatType().as_pointer())


@infer_getattr
class _FieldOfNumbers(AttributeTemplate):
    key = Numbers

    def generic_resolve(self, numbers: Numbers, name: str) -> types.Type | None:
        return SCALAR.get(numbers.kinds.get(name, ""))


@lower_getattr_generic(Numbers)
def _field_of_numbers(context: Any, builder: Any, numbers: Numbers, value: Any, name: str) -> Any:
    at = ir.IntType(64)(list(numbers.kinds).index(name))
    place = builder.bitcast(builder.gep(value, [at]), ELEMENT[numbers.kinds[name]].as_pointer())
    return _unchanging(builder, builder.load(place))


@intrinsic
def numbers(typingctx: Any, cls: Any, buffer: Any) -> Any:
    """The fields of a NamedTuple `cls` of numbers that stand one after the other in `buffer`, float32 [field]."""

    def emit(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        return cgutils.create_struct_proxy(buffer)(context, builder, values[1]).data

    return Numbers(cls.instance_class)(cls, buffer), emit
