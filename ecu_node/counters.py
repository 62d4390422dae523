"""What happened since the node was started."""

from dataclasses import asdict, dataclass

__all__ = ["Counters"]


@dataclass(kw_only=True)
class Counters:
    """Counted by the core and by the loop around it."""

    frames_in: int = 0
    """Frames of branches, their voltages and the state of [watch] received."""
    answers: int = 0
    """Corrected messages that an overlay node made, those with values passed through or not available included."""
    rewritten: int = 0
    """Frames in which a gateway wrote another current than was measured."""
    forwarded: int = 0
    """Frames passed on by a gateway, those that it rewrote included."""
    returned: int = 0
    """Frames passed on by a gateway from the vehicle to the sensors' bus."""
    not_returned: int = 0
    """Frames of the vehicle that the sensors' bus did not take."""
    held_back: int = 0
    """Frames that failed their check and that a gateway did not pass on."""
    corrupt: int = 0
    """Frames with a wrong CRC or an impossible counter."""
    repeated: int = 0
    """Frames with the counter of the one before."""
    jumped: int = 0
    """Frames whose counter was further on than the layout allows."""
    gaps: int = 0
    """Times that the counter showed a few lost frames."""
    short: int = 0
    """Frames too short for a signal that the layout reads from them."""
    late: int = 0
    """Frames of branches that were too old when they were read; nothing was made of them."""
    dropped: int = 0
    """Frames that the kernel dropped because they were not read in time."""
    saturated: int = 0
    """Corrected values beyond the ends of their signal; the end was sent instead."""
    echoes: int = 0
    """Own frames that came back."""
    send_errors: int = 0
    """Frames that the bus did not take."""
    bus_errors: int = 0
    """Error frames of the bus."""
    bus_off: int = 0
    """Times that the controller went off the bus."""
    reopened: int = 0
    """Times that the bus was opened again."""
    clock_steps: int = 0
    """Times that the time of day jumped against the steady clock; the times of reading are taken for a while then."""
    reloads: int = 0
    """Parameter files that took the place of the one before."""
    reload_failures: int = 0
    """Parameter files that did not fit; the ones before stayed in force."""

    def text(self) -> str:
        """One line for the log: what is not 0."""
        counted = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in asdict(self).items() if value)
        return counted or "no frames"
