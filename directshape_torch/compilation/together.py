"""Work all functions of which are compiled before it, side by side."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

from directshape_torch.compilation import regions
from directshape_torch.compilation.compilable import MAX_FORMS, Asked
from directshape_torch.compilation.helpers import compiled_by_helpers, num_helpers
from directshape_torch.compilation.regions import Region
from directshape_torch.compilation.request import CompileRequest
from directshape_torch.compilation.store import can_keep

_R = TypeVar("_R")


def compiled_together(work: Callable[[], _R]) -> _R:
    """Work inside a `compiling` region, all functions of which are compiled before it, side by side.

    Work that finds functions that are yet to be compiled runs plain to its end, so that all of them are known, and then
    again, until all are compiled, which is once as a rule: it must be repeatable.

    Example:
        >>> with regions.compiling("off", num_cars=1):
        ...     compiled_together(lambda: 3)
        3
    """
    region = regions.current_region()
    if region is None or region.wanted is not None:
        return work()
    while True:
        region.wanted = {}
        try:
            result = work()
        finally:
            wanted, region.wanted = region.wanted, None
        if not wanted:
            return result
        del result  # with all the memory that it holds
        _compile_all(wanted, region)


def _compile_all(wanted: Mapping[Asked, CompileRequest], region: Region) -> None:
    """Each of the last ones by a helper, as far as there are cores, for what is called late is the largest."""
    with regions.process_lock():
        # Another thread or process may have compiled some of them by now.
        rest = {asked: request for asked, request in wanted.items() if not _is_there(asked, request)}
        by_helpers = [asked for asked, request in rest.items() if _is_for_helpers(asked, request)]
        by_helpers = by_helpers[max(len(by_helpers) - num_helpers(len(rest)), 0) :]
        with compiled_by_helpers([rest[asked] for asked in by_helpers]):
            for asked, request in rest.items():
                if asked not in by_helpers:
                    _compile_one(asked, request, region)
        for asked in by_helpers:
            function, variant = asked
            if not function.load_again(variant):
                _compile_one(asked, rest[asked], region)


def _is_there(asked: Asked, request: CompileRequest) -> bool:
    function, variant = asked
    return function.count(variant) > request.number or function.load_again(variant)


def _is_for_helpers(asked: Asked, request: CompileRequest) -> bool:
    return request.number < MAX_FORMS and can_keep(asked[0].plain) and request.is_for_helpers()


def _compile_one(asked: Asked, request: CompileRequest, region: Region) -> None:
    function, variant = asked
    if region.mode == "on" or not regions.has_given_up():
        function.compile(variant, request, region.mode)
