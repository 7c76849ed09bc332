"""Numbers as a reader of the page sees them."""

import math

NO_BREAK = "\u00a0"


def duration(seconds: float | None) -> str:
    """Return `0.4 s`, `42 s`, `3 min 10 s` or `1 h 05 min` without line breaks; a dash for None."""
    if seconds is None or not math.isfinite(seconds):
        return "-"
    whole, minutes = round(seconds), round(seconds / 60)
    if seconds < 9.95:
        words = f"{seconds:.1f} s"
    elif whole < 60:
        words = f"{whole} s"
    elif whole < 3600:
        words = f"{whole // 60} min {whole % 60:02d} s"
    else:
        words = f"{minutes // 60} h {minutes % 60:02d} min"
    return words.replace(" ", NO_BREAK)


def percent(share: float) -> str:
    """Return `62 %` without line breaks; `99.5 %` where rounding would claim certainty."""
    digits = 1 if 0.99 <= share < 1 or 0 < share <= 0.01 else 0
    return f"{100 * share:.{digits}f}{NO_BREAK}%"
