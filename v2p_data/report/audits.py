"""What the audit says of a success function, as lines of a table."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from v2p_data.report.reading import as_dict, as_dicts, number


@dataclass(frozen=True, kw_only=True)
class CheckView:
    """One question of the audit."""

    asks: str
    passed: bool
    measured: str


@dataclass(frozen=True, kw_only=True)
class AuditView:
    """A success function held against the video."""

    score: float | None
    checks: list[CheckView]
    vetoed: str = ""
    """Why it must not be trained for, if it must not."""


def audit_view(data: Any) -> AuditView:
    """Return the audit that a task's file holds; without questions where there is none."""
    audit = as_dict(data)
    return AuditView(
        score=number(audit.get("score")),
        checks=[_check_view(check) for check in as_dicts(audit.get("checks"))],
        vetoed=str(audit.get("vetoed") or ""),
    )


def _check_view(check: Mapping[str, Any]) -> CheckView:
    """Return a line of the audit with what was measured in words."""
    name, share = check.get("name"), number(check.get("share"))
    if share is None:
        measured = ""
    elif name == "becomes_true":
        measured = f"after {100 * share:.1f} cm" if share >= 0 else "never"
    elif name == "reward_rises":
        measured = f"by {share:.3g}"
    elif name == "no_warnings":
        measured = f"{share:.0f} warnings" if share != 1 else "1 warning"
    else:
        measured = f"true in {100 * share:.0f} % of moments"
    return CheckView(
        asks=str(check.get("asks") or name or ""),
        passed=check.get("passed") is True,
        measured=measured,
    )
