"""What looks wrong about a recording, how sure that is, and what mends it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Finding:
    """One thing that looks wrong.

    Attributes:
        kind: short name; findings of one kind are about the same thing.
        text: what looks wrong, in words and numbers.
        remedy: what to change.
        certain: whether it is beyond doubt and spoils the result, so that a run should not begin.
        times: how often it was found.
    """

    kind: str
    text: str
    remedy: str = ""
    certain: bool = False
    times: int = 1

    def __str__(self) -> str:
        counted = f" ({self.times} times)" if self.times > 1 else ""
        return self.text + counted + (f"; {self.remedy}" if self.remedy else "")


def folded(findings: Iterable[Finding]) -> list[Finding]:
    """One finding for each kind, certain ones first: the first of the surest, with the number of all of its kind.

    Args:
        findings: in the order in which they were made.
    """
    kinds: dict[str, Finding] = {}
    for finding in findings:
        known = kinds.get(finding.kind)
        if known is None:
            kinds[finding.kind] = finding
        else:
            kept = finding if finding.certain and not known.certain else known
            kinds[finding.kind] = replace(kept, times=known.times + finding.times)
    return sorted(kinds.values(), key=lambda finding: not finding.certain)
