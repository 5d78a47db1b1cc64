"""A positioning servo drive: power, modes, faults (CiA 402-2)."""

from __future__ import annotations

from microdrivers.fakes.canopen import CanOpenNode, Identity, Loss, Temper
from microdrivers.fakes.canopen.emergency import BUS_COMMUNICATION, HEARTBEAT_LOST
from microdrivers.fakes.cia402.following_error import FollowingErrorWatch
from microdrivers.fakes.cia402.homing import Homing
from microdrivers.fakes.cia402.motion import Motion
from microdrivers.fakes.cia402.objects import RECEIVE_PDOS, TRANSMIT_PDOS, DriveObjects, DriveRatings
from microdrivers.fakes.cia402.orders import Order, Orders, Reaction
from microdrivers.fakes.cia402.profile_position import ProfilePosition
from microdrivers.fakes.cia402.states import ALWAYS, Control, Mode, State, commanded_state

SERVO_DRIVE = 0x00020192
"""1000h of a servo drive; a stepper drive's is 00040192h."""

FOLLOWING_ERROR = 0x8611
HARDWARE_LIMIT = 0xFF66
SENSOR_FAULTS = range(0x7300, 0x7400)

_PROFILE_POSITION, _HOMING = Mode.PROFILE_POSITION, Mode.HOMING
_PRODUCT_CODE = 0x0402
_SERIAL_NUMBERS = 4_020_000


class ServoDrive:
    """A node on the bus, and the axis that it moves.

    Attributes:
        node: what is attached to a bus.
        log: what concerned motion, as (t_ns, text): "enable", "disable", "quick stop", "move TARGET" (counts), "halt",
            "go on", "home METHOD", "homed", "home interrupted", "home error", "fault CODE", "fault reset", "restart".

    Args:
        seed: of all delays.
        homing_method, home_offset: 6098h and 607Ch, as somebody has set the drive up for good.
    """

    def __init__(
        self,
        motion: Motion,
        *,
        node_id: int,
        seed: int,
        name: str = "Emulated servo drive",
        device_type: int = SERVO_DRIVE,
        homing_method: int = 37,
        home_offset: int = 0,
        temper: Temper | None = None,
        reaction: Reaction | None = None,
    ) -> None:
        self.motion = motion
        self.state = State.SWITCH_ON_DISABLED
        self.log: list[tuple[int, str]] = []
        spec = motion.spec
        self.objects = DriveObjects(
            DriveRatings(
                max_speed=round(spec.max_speed_um_s * spec.counts_per_um),
                acceleration=round(spec.acceleration_um_s2 * spec.counts_per_um),
                counts_per_um=spec.counts_per_um,
                homing_method=homing_method,
                home_offset=home_offset,
            )
        )
        self._watch = FollowingErrorWatch(motion, self.objects)
        self.homing = Homing(motion, self.objects, log=self._log, on_started=self._watch.start)
        self._profile = ProfilePosition(
            motion, self.objects, self._watch, homed=lambda: self.homing.homed, log=self._log, on_motion=self._moves
        )
        self._orders = Orders(reaction or Reaction(), seed=seed)
        self._causes: set[int] = set()
        self._clear()
        self._connect_objects()
        self.node = CanOpenNode(
            node_id,
            Identity(device_type, _PRODUCT_CODE, _SERIAL_NUMBERS + node_id, name),
            self.objects,
            self,
            transmit=TRANSMIT_PDOS,
            receive=RECEIVE_PDOS,
            seed=seed + 1,
            temper=temper,
        )

    def _clear(self) -> None:
        self.mode = Mode.NONE
        self._word = 0
        self._orders.clear()
        self._after_brake: tuple[int, State] | None = None
        self._leaves_travel_ns: int | None = None
        self._watch.stop()

    def _connect_objects(self) -> None:
        objects, motion = self.objects, self.motion
        objects.control_word.write = self._control_written
        objects.mode.write = self._mode_written
        objects.status_word.read = self.status_at
        objects.mode_display.read = lambda _: self.mode
        objects.position_demand.read = motion.demand_at
        objects.position.read = motion.position_at
        objects.velocity.read = motion.speed_at
        objects.following_error.read = motion.following_error_at
        objects.inputs.read = motion.switches_at

    # ------------------------------------------------------------------ from outside

    def power_cycle(self, t_ns: int) -> None:
        """Off and on again: the table runs out, the zero is lost, faults are over."""
        self.node.power_cycle(t_ns)

    def inject_fault(
        self, t_ns: int, code: int, *, info: bytes = b"", register: int | None = None, lasting: bool = False
    ) -> None:
        """Let a fault happen; a `lasting` one cannot be reset before `remove_cause`."""
        with self.node.disturbing(t_ns) as now_ns:
            if lasting:
                self._causes.add(code)
            self.fault(now_ns, code, info=info, register=register)

    def remove_cause(self, t_ns: int, code: int) -> None:
        """A lasting fault can be reset now."""
        with self.node.disturbing(t_ns):
            self._causes.discard(code)

    def jam(self, t_ns: int) -> None:
        """Something holds the table from now on."""
        with self.node.disturbing(t_ns) as now_ns:
            self._leaves_travel_ns = None
            self.motion.jam(now_ns)

    def release(self, t_ns: int) -> None:
        """Nothing holds it any more: a drive under power goes where it wanted to be, but for homing."""
        with self.node.disturbing(t_ns) as now_ns:
            self.homing.fail(now_ns)
            self.motion.release(now_ns, resume=self.state is State.OPERATION_ENABLED)
            self._moves(now_ns)

    # ------------------------------------------------------------------ what the node asks (Application)

    def next_event_ns(self) -> int | None:
        """See `Application`."""
        due_ns = self._orders.due_ns
        for own_ns in (
            self._after_brake[0] if self._after_brake is not None else None,
            self._leaves_travel_ns,
            self._watch.due_ns,
            self.homing.due_ns,
            self._profile.due_ns,
        ):
            if own_ns is not None and (due_ns is None or own_ns < due_ns):
                due_ns = own_ns
        return due_ns

    def advance(self, t_ns: int) -> None:
        """See `Application`."""
        while (due_ns := self.next_event_ns()) is not None and due_ns <= t_ns:
            if due_ns == self._orders.due_ns:
                self._follow(self._orders.take())
            elif self._after_brake is not None and self._after_brake[0] == due_ns:
                self._disable(self._after_brake[1], due_ns)
            elif due_ns == self._leaves_travel_ns:
                self._leaves_travel_ns = None
                self.fault(due_ns, HARDWARE_LIMIT)
            elif due_ns == self._watch.due_ns:
                if self._watch.advance(due_ns):
                    self.fault(due_ns, FOLLOWING_ERROR)
            elif due_ns == self.homing.due_ns:
                self.homing.advance(due_ns)
            else:
                self._profile.advance(due_ns)

    def restart(self, t_ns: int) -> None:
        """See `Application`."""
        self.motion.switch_off(t_ns)
        self.homing.lose_reference()
        self._profile.cancel(finished=False)
        self.state = State.SWITCH_ON_DISABLED
        self._clear()
        self._log(t_ns, "restart")

    def communication_lost(self, loss: Loss, t_ns: int) -> None:
        """See `Application`: what 6007h says, after a missing heartbeat in any state, else only under power."""
        powered = self.state in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE)
        option = self.objects.abort_option.value
        if loss != "heartbeat" and not powered:
            return
        if option == 1:
            self.fault(t_ns, HEARTBEAT_LOST if loss == "heartbeat" else BUS_COMMUNICATION)
        elif option == 2 and powered:
            self._change_state(State.SWITCH_ON_DISABLED, t_ns)
        elif option == 3 and powered:
            self._change_state(State.QUICK_STOP_ACTIVE, t_ns)

    def communication_back(self, t_ns: int) -> None:
        """See `Application`: a fault stays until it is reset."""
        if self.state not in (State.FAULT, State.FAULT_REACTION):
            self.node.emergencies.pass_by(t_ns)

    # ------------------------------------------------------------------ status

    def status_at(self, t_ns: int) -> int:
        """The status word, 6041h."""
        bits: int = self.state | ALWAYS
        mode = self.mode
        if mode is _PROFILE_POSITION:
            bits |= self._profile.status_at(t_ns)
        elif mode is _HOMING:
            bits |= self.homing.status_at(t_ns)
        return bits

    # ------------------------------------------------------------------ commands

    def _control_written(self, word: int, t_ns: int) -> None:
        enables = word & 0x0F == 0x0F and self.state is not State.OPERATION_ENABLED
        self._orders.add(word, t_ns, enables=enables)
        self.advance(t_ns)

    def _mode_written(self, mode: int, t_ns: int) -> None:
        self._orders.add(mode, t_ns, is_mode=True)
        self.advance(t_ns)

    def _follow(self, order: Order) -> None:
        if order.is_mode:
            self._change_mode(Mode(order.value), order.t_ns)
            return
        word, t_ns = order.value, order.t_ns
        before, self._word = self._word, word
        if self.state is State.FAULT:
            if word & ~before & Control.FAULT_RESET:
                self._reset_fault(t_ns)
            return
        self._change_state(commanded_state(self.state, word), t_ns)
        if self.state is State.OPERATION_ENABLED and self._after_brake is None:
            if self.mode is Mode.PROFILE_POSITION:
                self._profile.control(word, before, t_ns)
            elif self.mode is Mode.HOMING:
                self.homing.control(word, before, t_ns)

    def _change_mode(self, mode: Mode, t_ns: int) -> None:
        if mode is self.mode:
            return
        if self.state is State.OPERATION_ENABLED and self.motion.moving_at(t_ns):
            self.motion.brake(t_ns, self.objects.deceleration.value)
        self._give_up_motion(t_ns, finished=True)
        self._profile.begin(self._word)
        self.mode = mode

    def _change_state(self, state: State, t_ns: int) -> None:
        if state is self.state:
            if state is State.OPERATION_ENABLED:
                self._after_brake = None
            return
        enabled = self.state is State.OPERATION_ENABLED
        if state is State.OPERATION_ENABLED:
            self._enable(t_ns)
        elif state is State.QUICK_STOP_ACTIVE:
            self._quick_stop(t_ns)
        elif enabled and state in (State.READY, State.SWITCHED_ON):
            option = self.objects.shutdown_option if state is State.READY else self.objects.disable_option
            self._brake_then(state, self.objects.deceleration.value if option.value else None, t_ns)
        else:
            self._disable(state, t_ns)

    def _enable(self, t_ns: int) -> None:
        if self.state is State.QUICK_STOP_ACTIVE and self._after_brake is not None:
            return  # this quick stop ends without power
        self._after_brake = None
        self.state = State.OPERATION_ENABLED
        self._log(t_ns, "enable")
        self._profile.begin(self._word)
        self._watch.start(t_ns)

    def _disable(self, state: State, t_ns: int) -> None:
        """Power off, but for a state that has none anyway."""
        if self.state in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION):
            self._give_up_motion(t_ns, finished=self._stands_at_target(t_ns))
            self.motion.let_go(t_ns)
            self._log(t_ns, "disable")
        self._after_brake = None
        self.state = state

    def _quick_stop(self, t_ns: int) -> None:
        option = self.objects.quick_stop_option.value
        self._log(t_ns, "quick stop")
        if option == 0:
            self._disable(State.SWITCH_ON_DISABLED, t_ns)
            return
        self._give_up_motion(t_ns, finished=self._stands_at_target(t_ns))
        self.state = State.QUICK_STOP_ACTIVE
        slow = option in (1, 5)
        rate = self.objects.deceleration if slow else self.objects.quick_deceleration
        end_ns = self.motion.brake(t_ns, rate.value)
        self._after_brake = (end_ns, State.SWITCH_ON_DISABLED) if option in (1, 2) else None

    def _brake_then(self, state: State, rate: float | None, t_ns: int) -> None:
        if rate is None or not self.motion.moving_at(t_ns):
            self._disable(state, t_ns)
            return
        self._give_up_motion(t_ns, finished=False)
        self._after_brake = (self.motion.brake(t_ns, rate), state)

    # ------------------------------------------------------------------ faults

    def fault(self, t_ns: int, code: int, *, info: bytes = b"", register: int | None = None) -> None:
        """A fault has happened: stop as 605Eh says, then power off until it is reset."""
        self.node.emergencies.happen(code, t_ns, info=info, register=register)
        self.objects.error_code.value = code
        self._log(t_ns, f"fault {code:04X}")
        if code in SENSOR_FAULTS:
            self.homing.lose_reference()
        if self.state in (State.FAULT, State.FAULT_REACTION):
            return
        self.homing.fail(t_ns)
        powered = self.state in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE)
        option = self.objects.fault_option.value
        if not powered or option == 0 or not self.motion.moving_at(t_ns):
            self._disable(State.FAULT, t_ns)
            return
        self._give_up_motion(t_ns, finished=False)
        self.state = State.FAULT_REACTION
        rate = self.objects.deceleration if option == 1 else self.objects.quick_deceleration
        self._after_brake = (self.motion.brake(t_ns, rate.value), State.FAULT)

    def _reset_fault(self, t_ns: int) -> None:
        if self._causes:
            return
        self.state = State.SWITCH_ON_DISABLED
        self.objects.error_code.value = 0
        self.node.emergencies.pass_by(t_ns)
        self._log(t_ns, "fault reset")

    # ------------------------------------------------------------------ motion

    def _moves(self, t_ns: int) -> None:
        self._leaves_travel_ns = self.motion.leaves_travel_ns(t_ns)
        self._watch.start(t_ns)

    def _stands_at_target(self, t_ns: int) -> bool:
        return self.mode is not Mode.PROFILE_POSITION or self._profile.reached_at(t_ns)

    def _give_up_motion(self, t_ns: int, *, finished: bool) -> None:
        self._leaves_travel_ns = None
        self._watch.stop()
        self._profile.cancel(finished=finished)
        self.homing.interrupt(t_ns)

    def _log(self, t_ns: int, text: str) -> None:
        self.log.append((t_ns, text))
