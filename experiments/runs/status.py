"""What has become of a run."""

import enum


class Status(enum.Enum):
    """How far a run has come."""

    ABSENT = "absent"
    """There is no run here."""
    PARTIAL = "partial"
    """It can be resumed."""
    FINISHED = "finished"
    """All its steps are taken."""
    DIVERGED = "diverged"
    """Every seed ended in numbers that are not finite. Resumed, it would end there again."""
