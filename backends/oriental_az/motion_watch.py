"""From what the drive reports to what may be said of the motor: moving, on target, referenced.

The motor counts as moving from the command on until the drive has said otherwise, or its command and its feedback
stand at the target. It counts as in position only when the drive says so. Position, command position and
command speed come with every sample; the output word costs an exchange of its own and is wanted only
`STATUS_PERIOD_S` after the last one, or when the command has ended and the motor has still to arrive.
"""

from __future__ import annotations

from microdrivers.backends.oriental_az.drive import COORDINATES_ESTABLISHED, Motion, Output, Status
from microdrivers.core.units import seconds_to_ns

STATUS_PERIOD_S = 0.5
"""An alarm is noticed within this time (plus one sample) while samples are read; at once if it ends a motion."""

FAR_STEPS = 20
"""A shorter way may take less time than a sample's time is uncertain by: there only the drive's own report counts."""

START_UP_S = 1.0
"""The drive takes no query for this long after power-on (HP-5142E): a shorter silence is not a power failure."""


class MotionWatch:
    """The state of the motor as far as it is known. Feed it with all that is read, in order of time.

    `may_have_restarted` tells whether the drive was silent before the latest status for as long as switching it off
    and on takes.

    Args:
        tolerance_steps: how far the feedback of a motor at rest may wander.
        settle_s: how long it must stand still to count as at rest where the drive does not report arrival, which it
            never does after a stop (HP-5142E, IN-POS output).
    """

    def __init__(self, *, tolerance_steps: int, settle_s: float) -> None:
        self.moving = True
        self.referenced = False
        self.may_have_restarted = False
        self.outputs = Output.NONE
        self._tolerance_steps = max(1, tolerance_steps)
        self._settle_ns = seconds_to_ns(settle_s)
        self._motion: Motion | None = None
        self._rest_steps = 0
        self._rest_since_ns = 0
        self._status_ns: int | None = None
        self._heard_ns = 0
        self._status_is_fresh = False
        self._command_ended = True
        self._reported_over = False
        self._target_steps: int | None = None
        self._operated = False
        self._link_failed = False

    @property
    def alarm(self) -> bool:
        """Whether the drive reported an alarm."""
        return Output.ALM_A in self.outputs

    @property
    def in_position(self) -> bool:
        """Whether the motor rests where its command ended."""
        return self._reported_over and not self.alarm and Output.IN_POS in self.outputs

    def commanded(self, target_steps: int | None = None) -> None:
        """A motion is about to be commanded; to `target_steps`, if that is known."""
        self.moving = True
        self._reported_over = False
        far = target_steps is not None and abs(target_steps - self._rest_steps) >= FAR_STEPS
        self._target_steps = target_steps if far else None
        self._operated = True
        self._status_is_fresh = False
        self._command_ended = False
        self._motion = None

    def link_failed(self) -> None:
        """An exchange failed; what the drive did meanwhile is not known."""
        self._link_failed = True
        self._status_is_fresh = False

    def wants_status(self, now_ns: int) -> bool:
        """Whether the output word is to be read before the motion."""
        if self._status_ns is None or self._link_failed or (self._command_ended and not self._reported_over):
            return True
        return now_ns - self._status_ns >= seconds_to_ns(STATUS_PERIOD_S)

    def see_status(self, status: Status) -> None:
        """Take in the output word."""
        self.may_have_restarted = self._link_failed and status.t_ns - self._heard_ns >= seconds_to_ns(START_UP_S)
        if self.may_have_restarted:
            self._operated = False  # its own word counts
        if COORDINATES_ESTABLISHED in status.outputs:
            self.referenced = True
            self._operated = False
        elif not self._operated and Output.MOVE not in status.outputs:
            self.referenced = False  # an operation may turn HOME-END off; nothing else may
        self.outputs = status.outputs
        self._status_ns = self._heard_ns = status.t_ns
        self._status_is_fresh = True
        self._link_failed = False

    def see_motion(self, motion: Motion) -> None:
        """Take in command and feedback, read after the output word if that was wanted."""
        last, self._motion = self._motion, motion
        self._heard_ns = motion.t_ns
        self._command_ended = motion.command_speed_hz == 0
        undisturbed = (
            self._command_ended
            and last is not None
            and motion.command_position == last.command_position
            and abs(motion.feedback_position - self._rest_steps) <= self._tolerance_steps
        )
        if not undisturbed:
            self._rest_steps = motion.feedback_position
            self._rest_since_ns = motion.t_ns
        if self._is_reported_over(motion):
            self._reported_over = True
            self.moving = False
        elif undisturbed and self._has_arrived(motion):  # the first time, it may have moved as the interval began
            self.moving = False
        elif not undisturbed:
            self._reported_over = False
            self.moving = True
            self._operated = True
        self._status_is_fresh = False

    def _has_arrived(self, motion: Motion) -> bool:
        """Whether command and feedback stand where they were sent: no more pulses will come."""
        return (
            self._target_steps is not None
            and self._command_ended
            and motion.command_position == self._target_steps
            and abs(motion.feedback_position - self._target_steps) <= self._tolerance_steps
        )

    def _is_reported_over(self, motion: Motion) -> bool:
        if not self._status_is_fresh or Output.MOVE in self.outputs or not self._command_ended:
            return False
        stands_still = motion.t_ns - self._rest_since_ns >= self._settle_ns
        return Output.IN_POS in self.outputs or stands_still
