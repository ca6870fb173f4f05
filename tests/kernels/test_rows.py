"""Native rows have the cost, gradient and matrix of tensor operations, and hand on the same points."""

from __future__ import annotations

from typing import Any, NamedTuple

import pytest
import torch
from helpers.single_precision import in_single
from torch import Tensor

from directshape_torch.laboratory.bench import Bench
from directshape_torch.numerics.tables import Chosen
from directshape_torch.shape.field import Field, field_of
from directshape_torch.state.unknowns import State
from directshape_torch.terms.term import AnyTerm, Part, in_all_columns, part_of, parts_of

pytestmark = pytest.mark.usefixtures("no_gradients")

NAMES = ("silhouettes", "photometric")


class Rows(NamedTuple):
    """A term at a state that has moved away from its anchor."""

    term: AnyTerm
    field: Field
    state: State
    anchor: Any

    def natively(self, fisher: bool = True) -> Part[Any]:
        part = self.term.native_part(self.field, self.state, self.anchor, fisher)
        assert part is not None
        return part

    def by_tensors(self, fisher: bool = True) -> Part[Any]:
        at = self.term.linear(self.field, self.state, self.anchor)
        return part_of(self.term, in_all_columns(self.term, self.state, at), fisher)


def rows_of(bench: Bench, name: str) -> Rows:
    """The rows of a bench, float64, after a step of centimetres."""
    term, size = bench.terms[name], bench.num_unknowns
    state = bench.moved(0.02 * torch.cos(torch.arange(size, dtype=torch.float64)))
    return Rows(term, field_of(bench.problem.prior.bind(state.code)), state, term.anchor(bench.prepared))


def sums(part: Part[Any]) -> list[Tensor]:
    """Cost, gradient and both matrices of all blocks together."""
    return [x.sum(dim=0) for x in (part.cost, part.products[:, -1], part.products[:, :-1], part.information)]


def relative(part: Part[Any], true: Part[Any]) -> list[float]:
    return [float((x - y).abs().max() / y.abs().max()) for x, y in zip(sums(part), sums(true), strict=True)]


@pytest.mark.parametrize("name", NAMES)
def test_rows_are_those_of_tensor_operations_in_every_regime(bench: Bench, name: str) -> None:
    """Within 1e-5, or where single precision itself is further from double precision, within five times that."""
    double = rows_of(bench, name)
    if not len(double.term.blocks.owner):
        assert (bench.regime.name, name) == ("grid_border", "photometric")
        return
    single = in_single(double)
    native, tensors, true = single.natively(), single.by_tensors(), double.by_tensors()
    own_error = relative(tensors, true)
    for apart, own in zip(relative(native, tensors), own_error, strict=True):
        assert apart < max(1e-5, 5 * own)
    for apart, own in zip(relative(native, true), own_error, strict=True):
        assert apart < max(1e-5, 5 * own)
    filled = single.term.row_weight > 0
    residual = (native.residual - tensors.residual).abs()[filled.expand_as(native.residual)]
    assert float(residual.quantile(0.99)) < 1e-3 * float(tensors.residual.abs().max())
    check_points(native.anchor, tensors.anchor)


def check_points(found: Any, expected: Any) -> None:
    """The anchors, where they say something: rays that miss have depths and faces without meaning."""
    flags = next(field for field in ("crosses", "on_surface") if hasattr(found, field))
    where = getattr(expected, flags)
    assert torch.equal(getattr(found, flags), where)
    assert float((found.points_obj - expected.points_obj).abs().quantile(0.99)) < 3e-5
    assert float((found.depth - expected.depth).abs()[where].quantile(0.99)) < 3e-5 if bool(where.any()) else True
    if flags == "on_surface":
        assert torch.equal(found.usable, expected.usable)


@pytest.mark.parametrize("name", NAMES)
def test_a_car_alone_has_the_bits_that_it_has_beside_others_and_again(typical: Bench, name: str) -> None:
    rows = in_single(rows_of(typical, name))
    whole = rows.natively()
    again = rows.natively()
    assert all(torch.equal(x, y) for x, y in zip(whole[:4], again[:4], strict=True))
    for car in range(3):
        chosen = Chosen.where(torch.arange(3) == car)
        blocks = rows.term.blocks.kept(chosen)
        field = rows.field._replace(values=rows.field.values[car : car + 1])  # type: ignore[attr-defined]
        state = type(rows.state)(*(x[car : car + 1] for x in rows.state))
        anchor = type(rows.anchor)(*(x.index_select(-2, blocks) for x in rows.anchor))
        alone = Rows(rows.term.of(chosen), field, state, anchor).natively()
        assert all(torch.equal(x, y[blocks]) for x, y in zip(alone[:4], whole[:4], strict=True))
        assert all(torch.equal(x, y.index_select(-2, blocks)) for x, y in zip(alone.anchor, whole.anchor, strict=True))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("what", ["pose", "values", "anchor"])
def test_numbers_gone_wrong_stay_with_their_car(typical: Bench, name: str, what: str) -> None:
    """Such numbers show in the cost or gradient of their own car, unless its rays are only lost."""
    rows = in_single(rows_of(typical, name))
    expected = rows.natively()
    wrong = torch.tensor([0])
    if what == "pose":
        T_obj_cam = rows.state.T_obj_cam.index_fill(0, wrong, torch.nan)
        rows = rows._replace(state=rows.state._replace(T_obj_cam=T_obj_cam))  # type: ignore[attr-defined]
    elif what == "values":
        values = rows.field.values.index_fill(0, wrong, torch.nan)  # type: ignore[attr-defined]
        rows = rows._replace(field=rows.field._replace(values=values))  # type: ignore[attr-defined]
    else:
        blocks = (rows.term.blocks.owner == 0).nonzero()[:, 0]
        rows = rows._replace(anchor=rows.anchor._replace(points_obj=rows.anchor.points_obj.index_fill(1, blocks, 3e38)))
    found, others = rows.natively(), rows.term.blocks.owner > 0
    assert all(torch.equal(x[others], y[others]) for x, y in zip(found[:4], expected[:4], strict=True))
    tensors = rows.by_tensors()
    for x, y in zip(found[:2], tensors[:2], strict=True):
        finite, finite_ = (value[~others].reshape(int((~others).sum()), -1).isfinite().all(dim=1) for value in (x, y))
        assert torch.equal(finite, finite_)


@pytest.mark.parametrize("name", NAMES)
def test_no_rows_at_all(typical: Bench, name: str) -> None:
    rows = in_single(rows_of(typical, name))
    nobody = Chosen.where(torch.zeros(3, dtype=torch.bool))
    anchor = type(rows.anchor)(*(x[..., :0, :] for x in rows.anchor))
    part = rows._replace(term=rows.term.of(nobody), anchor=anchor).natively()
    assert part.products.shape == (0, typical.num_unknowns + 1, typical.num_unknowns)


@pytest.mark.parametrize("name", NAMES)
def test_tensors_with_jumps_in_memory_give_the_same_bits(typical: Bench, name: str) -> None:
    rows = in_single(rows_of(typical, name))
    anchor = type(rows.anchor)(*(x.mT.contiguous().mT for x in rows.anchor))
    field = rows.field._replace(values=rows.field.values.mT.contiguous().mT)  # type: ignore[attr-defined]
    found = rows._replace(field=field, anchor=anchor).natively()
    expected = rows.natively()
    assert all(torch.equal(x, y) for x, y in zip(found[:4], expected[:4], strict=True))
    assert all(torch.equal(x, y) for x, y in zip(found.anchor, expected.anchor, strict=True))


def test_rows_without_a_loop_take_tensor_operations_beside_those_that_have_one(typical: Bench) -> None:
    names = "silhouettes", "silhouettes_product", "photometric"
    rows = [in_single(rows_of(typical, name)) for name in names]
    terms, anchors = tuple(x.term for x in rows), tuple(x.anchor for x in rows)
    assert rows[1].term.native_part(*rows[1][1:], fisher=True) is None
    for fisher in (True, False):
        parts = parts_of(terms, rows[0].field, rows[0].state, anchors, fisher)
        expected = rows[0].natively(fisher), rows[1].by_tensors(fisher), rows[2].natively(fisher)
        for part, same in zip(parts, expected, strict=True):
            assert torch.equal(part.products, same.products)
            assert torch.equal(part.information, same.information)


def test_the_fisher_matrix_is_the_matrix_of_the_products_where_nobody_asks_for_it(typical: Bench) -> None:
    rows = in_single(rows_of(typical, "silhouettes"))
    with_fisher, without = rows.natively(), rows.natively(fisher=False)
    assert torch.equal(with_fisher.products, without.products)
    assert torch.equal(without.information, without.products[:, :-1])
    assert not torch.equal(with_fisher.information, without.information)


@pytest.mark.parametrize("name", NAMES)
def test_double_precision_and_a_subclass_take_tensor_operations(typical: Bench, name: str) -> None:
    double = rows_of(typical, name)
    assert double.term.native_part(*double[1:], fisher=True) is None
    rows = in_single(double)
    changed = object.__new__(type("Changed", (type(rows.term),), {}))
    vars(changed).update(vars(rows.term))
    assert changed.native_part(*rows[1:], fisher=True) is None
