"""The sample stage: two linear axes and one rotation."""

from __future__ import annotations

from collections.abc import Mapping

from microdrivers.core.samples import XYThetaSample
from microdrivers.core.units import Range, check_range
from microdrivers.devices.motion import Move
from microdrivers.devices.stage import Stage

AXES = ("x", "y", "theta")
_SLOWEST_DEG_S = 1e-6


class XYThetaStage(Stage[XYThetaSample]):
    """An XYθ stage: µm and degrees; see `Stage`."""

    sample_type = XYThetaSample
    axis_names = AXES

    def move_to(
        self,
        *,
        x_um: float | None = None,
        y_um: float | None = None,
        theta_deg: float | None = None,
        speed_um_s: float | None = None,
        theta_speed_deg_s: float | None = None,
    ) -> XYThetaSample:
        """Move to an absolute position and block until settled; returns the observed pose.

        Raises:
            OutOfRange, NotReferenced, LinkLost: before anything moves.
            MotionError: the move began and did not end as asked; the stage was stopped.
        """
        move = self.start_move_to(
            x_um=x_um,
            y_um=y_um,
            theta_deg=theta_deg,
            speed_um_s=speed_um_s,
            theta_speed_deg_s=theta_speed_deg_s,
        )
        return move.wait()

    def move_by(
        self,
        *,
        dx_um: float = 0.0,
        dy_um: float = 0.0,
        dtheta_deg: float = 0.0,
        speed_um_s: float | None = None,
        theta_speed_deg_s: float | None = None,
    ) -> XYThetaSample:
        """Move relative to the last target (or the present pose if there is none) and block until settled.

        It is sent as an absolute target, once: a failed exchange is never repeated.
        """
        targets = self._shifted({"x": dx_um, "y": dy_um, "theta": dtheta_deg})
        return self.move_to(
            x_um=targets["x"],
            y_um=targets["y"],
            theta_deg=targets["theta"],
            speed_um_s=speed_um_s,
            theta_speed_deg_s=theta_speed_deg_s,
        )

    def start_move_to(
        self,
        *,
        x_um: float | None = None,
        y_um: float | None = None,
        theta_deg: float | None = None,
        speed_um_s: float | None = None,
        theta_speed_deg_s: float | None = None,
    ) -> Move[XYThetaSample]:
        """Command an absolute move and return at once; a newer move supersedes an older one.

        `speed_um_s` is the path speed in the xy plane: x and y arrive together. Default: as fast as the axes allow.
        """

        def speeds_of(start: Mapping[str, float], targets: Mapping[str, float]) -> dict[str, float]:
            speeds = self._path_speeds(start, targets, ("x", "y"), speed_um_s)
            if "theta" in targets:
                fastest = self.max_speed["theta"]
                asked = fastest if theta_speed_deg_s is None else theta_speed_deg_s
                limits = Range(_SLOWEST_DEG_S, fastest)
                speeds["theta"] = check_range(
                    asked, limits, what="theta speed", unit="deg/s", device=self.name, in_file="max"
                )
            return speeds

        return self._command({"x": x_um, "y": y_um, "theta": theta_deg}, speeds_of)
