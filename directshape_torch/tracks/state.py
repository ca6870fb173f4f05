"""What is unknown of a view of a track beside pose and shape: the path of the track, and where its next view stands."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from directshape_torch.state.cars import CarState
from directshape_torch.state.unknowns import CODE, OFFSET, POSE, Block, State, Unknowns, blocks_of_car

PATH, NEXT_POSE = "path", "next_pose"


class TrackState(NamedTuple):
    """What is unknown of B views of tracks: a `State`."""

    T_obj_cam: Tensor  # (B, 4, 4) left camera to object
    code: Tensor  # (B, K) standard deviations
    offset_px: Tensor  # (B, S) see `CarState`
    path: Tensor  # (B, N) of its track on the ground, see `tracks.path`; N is 9, or 0 where there is none
    # (B, M, 4, 4) next view of its track to object, see `tracks.next_view`; M is 1, or 0 where nobody looks there
    T_obj_next: Tensor

    @classmethod
    def of(cls, state: State) -> TrackState:
        """Views that follow no path and look at no other view."""
        code = state.code
        return cls(
            state.T_obj_cam, code, state.offset_px, code.new_zeros(len(code), 0), code.new_zeros(len(code), 0, 4, 4)
        )

    @property
    def alone(self) -> CarState:
        """The state without what belongs to the track."""
        return CarState(*self[:3])

    @property
    def unknowns(self) -> Unknowns:
        """Blocks of the tangent `(v, omega, dcode, doffset, dpath, v_next, omega_next)`."""
        of_car = blocks_of_car(self.code.shape[1], self.offset_px.shape[1])
        # A path follows its views, and the next view is one of them: neither limits a step.
        path = Block(PATH, self.path.shape[1])
        next_pose = Block(NEXT_POSE, 6 * self.T_obj_next.shape[1], belongs_to="pose", is_pose=True)
        return Unknowns((*of_car, path, next_pose))


def own_and_shared(alone: State) -> tuple[Tensor, Tensor]:
    """Numbers of a view's own unknowns, and of those of the shape."""
    unknowns, device = alone.unknowns, alone.code.device
    return unknowns.columns((POSE, OFFSET), device), unknowns.columns((CODE,), device)
