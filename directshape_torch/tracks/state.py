"""This module adds unknowns to the views of a track: the path of the track and the pose of the car in the next view."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from torch import Tensor

from directshape_torch.numerics.records import Dense
from directshape_torch.state.cars import CarState
from directshape_torch.state.unknowns import CODE, OFFSET, POSE, Block, State, Unknowns, blocks_of_car

PATH, NEXT_POSE = "path", "next_pose"


class TrackState(NamedTuple):
    """A `TrackState` is the `State` of B views of tracks."""

    T_obj_cam: Annotated[Tensor, Dense("B", 4, 4)]  # left camera to object
    code: Annotated[Tensor, Dense("B", "K")]  # standard deviations
    offset_px: Annotated[Tensor, Dense("B", "S")]  # see `CarState`
    # path of the track on the ground, see `tracks.path`; N is 9, or 0 without a path
    path: Annotated[Tensor, Dense("B", "N")]
    # camera of the next view to object, see `tracks.next_view`; V is 1, or 0 without the next-view term
    T_obj_next: Annotated[Tensor, Dense("B", "V", 4, 4)]

    @classmethod
    def of(cls, state: State) -> TrackState:
        """State of views that follow no path and have no next view."""
        code = state.code
        return cls(
            state.T_obj_cam, code, state.offset_px, code.new_zeros(len(code), 0), code.new_zeros(len(code), 0, 4, 4)
        )

    @property
    def alone(self) -> CarState:
        """The state without the unknowns of the track."""
        return CarState(*self[:3])

    @property
    def unknowns(self) -> Unknowns:
        """Blocks of the tangent `(v, omega, dcode, doffset, dpath, v_next, omega_next)`."""
        of_car = blocks_of_car(self.code.shape[1], self.offset_px.shape[1])
        # The path follows its views, and the next view has limits of its own, so neither block limits a step.
        path = Block(PATH, self.path.shape[1])
        next_pose = Block(NEXT_POSE, 6 * self.T_obj_next.shape[1], belongs_to="pose", is_pose=True)
        return Unknowns((*of_car, path, next_pose))


def own_and_shared(alone: State) -> tuple[Tensor, Tensor]:
    """Column numbers of the unknowns that each view has alone, and column numbers of the shared shape."""
    unknowns, device = alone.unknowns, alone.code.device
    return unknowns.columns((POSE, OFFSET), device), unknowns.columns((CODE,), device)
