"""The XYθ stage on GCS 2.0 controllers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence

from microdrivers.backends.lines.serial_line import Exchange, SerialLine
from microdrivers.backends.pi_gcs.axis_map import AxisMap
from microdrivers.backends.pi_gcs.chain_pose import PoseReader
from microdrivers.backends.pi_gcs.controller import Controller, Reading
from microdrivers.backends.pi_gcs.protocol import Gcs
from microdrivers.backends.pi_gcs.referencing import ReferenceSearch
from microdrivers.backends.pi_gcs.settings import GcsStageSettings
from microdrivers.backends.pi_gcs.steady_pose import SteadyPose
from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.core.errors import DeviceFault, LinkError, MicrodriversError, MoveCancelled, RefusedError
from microdrivers.core.samples import XYThetaSample
from microdrivers.devices.base import DeviceInfo
from microdrivers.devices.wire_tap import WireTap
from microdrivers.devices.xytheta_stage import AXES, XYThetaStage

FAULT_FLAG = "FAULT"
_FAULT, _NO_FLAGS = frozenset({FAULT_FLAG}), frozenset[str]()


class GcsXYThetaStage(XYThetaStage):
    """Three axes of one multi-axis GCS 2.0 controller (C-884 class), or of three in a daisy chain (C-863.12 class).

    Positions and status of a controller's axes come from one write and are stamped at the instant at which it samples
    them: the end of the request plus `latch.delay_ms`. How those of a chain become one pose stands in `chain_pose`.

    The controllers of a chain are sent their moves one after the other: each axis starts when the command of the one
    before has been answered, about 5 ms later at 115200 baud. A path at 1 mm/s is therefore off by about 5 µm until the
    axes come to rest, where it is not. A stop is one write for all.

    The first move of a referenced axis switches its servo on. A servo that drops by itself is a fault until
    `clear_fault()`; until then samples carry the flag `FAULT`. A controller that has forgotten its reference (power
    cycle) gives the event `reference_lost`; the axes of the others keep theirs.
    """

    def __init__(self, name: str, settings: GcsStageSettings, *, clock: Clock, bus: Bus) -> None:
        super().__init__(name, clock=clock, bus=bus)
        self.settle_s = settings.settle_s
        self._settings = settings
        self._line = SerialLine(settings.connection, clock=clock, tap=WireTap(name, bus))
        self._controllers = self._make_controllers()
        self._alone = self._controllers[0] if len(self._controllers) == 1 else None
        self._poses = PoseReader(self._ask_all)
        self._steady: SteadyPose | None = None
        self._adopt_limits()

    def _make_controllers(self) -> tuple[Controller, ...]:
        settings = {axis: getattr(self._settings.axes, axis) for axis in AXES}
        groups = [(axis,) for axis in AXES] if self._settings.axes.chained else [AXES]
        languages = [Gcs(self._line, address=settings[group[0]].address) for group in groups]
        for gcs in languages:
            gcs.neighbours = [other for other in languages if other is not gcs]
        return tuple(
            Controller(
                gcs,
                {axis: AxisMap.from_settings(settings[axis]) for axis in group},
                self._settings,
                name=self.name,
                reference_lost=lambda reason: self._publish_event("reference_lost", reason=reason),
            )
            for gcs, group in zip(languages, groups, strict=True)
        )

    def _adopt_limits(self) -> None:
        self.axes = {axis: found.spec for controller in self._controllers for axis, found in controller.axes.items()}

    @property
    def referenced(self) -> Mapping[str, bool]:
        """Whether the reference of each axis is known, as its controller last reported (FRF?)."""
        return {axis: known for controller in self._controllers for axis, known in controller.state.referenced.items()}

    # ------------------------------------------------------------------ life

    def _connect(self) -> None:
        self._line.open()

    def _identify(self) -> DeviceInfo:
        try:
            found = [controller.identify() for controller in self._controllers]
        except MicrodriversError as error:
            error.moved = "no"
            raise
        self._poses = PoseReader(self._ask_all)
        self._steady = None
        self._adopt_limits()
        return _joined(found)

    @property
    def line_counters(self) -> Mapping[str, int]:
        """What has happened on the line since it was opened."""
        return vars(self._line.counters)

    def _close(self) -> None:
        for controller in self._controllers:
            controller.gcs.leave()
        self._line.close()
        for controller in self._controllers:
            controller.forget()

    def _stop(self) -> None:
        self._controllers[0].gcs.stop()
        for controller in self._controllers:
            controller.forget_targets()

    def _clear_fault(self) -> None:
        _each(self._controllers, Controller.clear_fault)

    # ------------------------------------------------------------------ reading

    def _read(self) -> XYThetaSample:
        """A pose, with little work if nothing but positions has changed since the last one."""
        controller = self._alone
        if controller is None:
            return self._sample(self._poses.read())
        targets = controller.targets
        exchange = controller.gcs.ask_pose()
        steady = self._steady
        positions = None if steady is None else steady.positions_in(exchange.reply, controller.mark())
        if steady is None or positions is None:
            return self._work_out(controller, exchange, targets)
        t_ns, dt_ns, source = controller.stamp(exchange)
        return XYThetaSample(
            t_ns=t_ns,
            dt_ns=dt_ns,
            t_source=source,
            device=self.name,
            seq=self._next_seq(),
            flags=_FAULT if controller.state.dropped else _NO_FLAGS,
            x_um=positions[0],
            y_um=positions[1],
            theta_deg=positions[2],
            target_x_um=targets["x"],
            target_y_um=targets["y"],
            target_theta_deg=targets["theta"],
            moving=steady.moving,
            on_target=steady.on_target,
            referenced=steady.referenced,
        )

    def _work_out(self, controller: Controller, exchange: Exchange, targets: Mapping[str, float]) -> XYThetaSample:
        """What an exchange means, and whether the next one may be taken to mean the same."""
        mark, self._steady = controller.mark(), None
        reading = controller.understand(exchange, mark, targets)
        if controller.contradicted_by(reading):
            controller.examine()
        sample = self._sample(reading)
        if mark == controller.mark():
            self._steady = SteadyPose.after(exchange.reply, sample, mark, controller.axes)
        return sample

    def _sample(self, pose: Reading) -> XYThetaSample:
        status = pose.status.values()
        in_servo = [axis_status for axis_status in status if axis_status.servo_on]
        targets = self._still_valid(pose.targets)
        return XYThetaSample(
            t_ns=pose.t_ns,
            dt_ns=pose.dt_ns,
            t_source=pose.source,
            device=self.name,
            seq=self._next_seq(),
            flags=_FAULT if any(found.state.dropped for found in self._controllers) else _NO_FLAGS,
            x_um=pose.positions["x"],
            y_um=pose.positions["y"],
            theta_deg=pose.positions["theta"],
            target_x_um=targets["x"],
            target_y_um=targets["y"],
            target_theta_deg=targets["theta"],
            moving=any(axis_status.moving or axis_status.referencing for axis_status in status),
            # An axis without servo holds no target and is never "on" it; the others decide.
            on_target=bool(in_servo) and all(axis_status.on_target for axis_status in in_servo),
            referenced=all(all(found.state.referenced.values()) for found in self._controllers),
        )

    def _still_valid(self, targets: Mapping[str, float]) -> dict[str, float]:
        """The targets without those that have been given up while the axes were asked."""
        given_up = [
            axis
            for controller in self._controllers
            for axis, target in controller.targets.items()
            if math.isnan(target)
        ]
        return {**targets, **dict.fromkeys(given_up, math.nan)}

    def _ask_all(self) -> Sequence[Reading]:
        """One reading of each controller, in turn; what contradicts expectation is looked into."""
        readings = [controller.read() for controller in self._controllers]
        doubtful = [
            controller
            for controller, reading in zip(self._controllers, readings, strict=True)
            if controller.contradicted_by(reading)
        ]
        _each(doubtful, Controller.examine)
        return readings

    # ------------------------------------------------------------------ moving

    def _start_move(self, targets: Mapping[str, float], speeds: Mapping[str, float]) -> None:
        stops = self._stops
        parts = [
            (controller, axes)
            for controller in self._controllers
            if (axes := [axis for axis in controller.axes if axis in targets])
        ]
        try:
            for controller, axes in parts:
                controller.check(axes)
            for controller, axes in parts:
                controller.prepare(_only(axes, speeds))
            if self._stops != stops:
                raise MoveCancelled("a stop was sent while the move was being prepared")
        except MicrodriversError as error:
            error.moved = "no"
            raise
        begun: list[str] = []
        for controller, axes in parts:
            try:
                controller.start(_only(axes, targets), _only(axes, speeds))
                begun += axes
                if self._stops != stops:
                    raise MoveCancelled("a stop was sent while the move was being started")
            except MicrodriversError as error:
                self._give_up(error, begun, stopped=self._stops != stops)
                raise

    @property
    def _stops(self) -> int:
        """Changes before and after every stop that is sent, to whichever controller."""
        return self._controllers[0].gcs.stops

    def _give_up(self, error: MicrodriversError, begun: Sequence[str], *, stopped: bool) -> None:
        """A move could not be started on all of its axes: stop those that may move, and say so in the error.

        Raises:
            MoveCancelled: instead of an error that stands for nothing having moved.
        """
        # A stop that was sent meanwhile may have come before the last command: it needs another one.
        if not (stopped or begun or isinstance(error, DeviceFault)):
            return
        try:
            XYThetaStage.stop(self, by="driver", reason=f"a move could not be started: {error.what}")
            end = "stopped"
        except LinkError:
            end = "could not be stopped"
        if not begun:
            return
        error.what += f"; axis {', '.join(begun)} had begun to move and {end}"
        error.moved = "yes"
        if isinstance(error, RefusedError):
            raise MoveCancelled(error.what, remedy=error.remedy, moved="yes") from error

    # ------------------------------------------------------------------ referencing

    def _reference_axis(self, axis: str) -> None:
        search = ReferenceSearch(
            next(controller for controller in self._controllers if axis in controller.axes), axis,
            clock=self.clock, timeout_s=self._settings.reference_timeout_s,
            stop=lambda by, reason: XYThetaStage.stop(self, by=by, reason=reason),
        )  # fmt: skip
        search.run()


def _only(axes: Iterable[str], values: Mapping[str, float]) -> dict[str, float]:
    return {axis: values[axis] for axis in axes}


def _each(controllers: Iterable[Controller], action: Callable[[Controller], object]) -> None:
    """Do it with every controller, also if it fails with one; then raise what went wrong, a fault first."""
    errors: list[MicrodriversError] = []
    for controller in controllers:
        try:
            action(controller)
        except MicrodriversError as error:
            errors.append(error)
    if errors:
        first, *others = sorted(errors, key=lambda error: not isinstance(error, DeviceFault))
        first.what = "; ".join(error.what for error in (first, *others))
        raise first


def _joined(found: Sequence[DeviceInfo]) -> DeviceInfo:
    """What the controllers say of themselves, in the order x, y, theta where they differ."""

    def join(texts: Sequence[str]) -> str:
        return texts[0] if len(set(texts)) == 1 else "/".join(texts)

    return DeviceInfo(
        driver=found[0].driver,
        vendor=join([info.vendor for info in found]),
        model=join([info.model for info in found]),
        serial_number="/".join(info.serial_number for info in found),
        firmware=join([info.firmware for info in found]),
    )
