"""What got worse since the results that were kept."""

from __future__ import annotations

from benchmarks.real.judge import SetResult

#: A figure fails whose pull exceeds the first, and the kept one by the factor.
PULL, PULL_FACTOR = 2.0, 1.1
#: Held-out chi2 over n, in total and of the worst measurement, may grow by this share and this much above 1, which is
#: what a true covariance gives: what another compiler changes. Below 1 a rise is no loss, as a covariance was too wide.
CHI2_SHARE, CHI2_MORE = 0.1, 0.05
#: CPU time and memory may grow by these factors, and by these few seconds and MB besides: what a busy computer changes.
CPU_FACTOR, CPU_MORE_S = 1.5, 3.0
MEMORY_FACTOR, MEMORY_MORE_MB = 1.25, 32.0


def worse(before: SetResult, now: SetResult) -> list[str]:
    """What got worse, a sentence each."""
    if now.failed:
        return [] if before.failed else [f"fails: {now.failed}"]
    found = []
    kept = {figure.name: figure for figure in before.figures}
    for figure in now.figures:
        old = kept.get(figure.name)
        if figure.value is None and old is not None and old.value is not None:
            found.append(f"{figure.name}: not determined any more")
        elif figure.pull is not None and abs(figure.pull) > PULL:
            least = abs(old.pull) if old is not None and old.pull is not None else 0.0
            if abs(figure.pull) > PULL_FACTOR * least:
                found.append(f"{figure.name}: pull {figure.pull:+.1f}, was {least:.1f}")
    for what, old_names, new_names in (
        ("a figure that can't be known is given", before.made_up, now.made_up),
        ("a name that an independent look contradicts", before.contradicted, now.contradicted),
        ("a name that isn't given any more", before.missing, now.missing),
        ("a remainder that isn't told", _silent(before), _silent(now)),
    ):
        found += [f"{what}: {name}" for name in new_names if name not in old_names]
    pairs = [("held-out chi2 over n", before.over_n, now.over_n)]
    if before.worst is not None and now.worst is not None:
        what = f"worst held-out chi2 over n ({now.worst.measurement})"
        pairs.append((what, before.worst.after_over_n, now.worst.after_over_n))
    for what, old, new in pairs:
        if old is not None and new is not None and new > (1.0 + CHI2_SHARE) * max(old, 1.0) + CHI2_MORE:
            found.append(f"{what}: {new:.3g}, was {old:.3g}")
    if now.cpu_s > CPU_FACTOR * before.cpu_s + CPU_MORE_S:
        found.append(f"CPU time: {now.cpu_s:.0f} s, was {before.cpu_s:.0f} s")
    if now.memory_mb > MEMORY_FACTOR * before.memory_mb + MEMORY_MORE_MB:
        found.append(f"memory: {now.memory_mb:.0f} MB, was {before.memory_mb:.0f} MB")
    return found


def _silent(result: SetResult) -> tuple[str, ...]:
    return tuple(f"{m.side} {m.measurement}" for m in result.measurements if m.is_silent)
