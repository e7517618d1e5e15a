"""Commands about this machine."""

from __future__ import annotations

from studio.commands.terminal import Json, console, print_json, table_of


def doctor(json: Json = False) -> int:
    """Say what is missing on this machine, and what installs it."""
    from studio.doctor import as_json, as_text, diagnose

    findings = diagnose()
    print(as_json(findings) if json else as_text(findings))
    return 0


def bench(only: tuple[str, ...] = (), json: Json = False) -> int:
    """Measure speed and contact on this machine: medians, with the load average beside them.

    Exit status 1 where a part could not be measured; a goal that is missed is only told.

    Args:
        only: Run only these parts.
    """
    from studio.benchmarks import PARTS, run

    results = run(only, tell=None if json else lambda name: console.print(f"… {name}", style="dim"))
    failed = results["failed"]
    if json:
        print_json(results)
        return bool(failed)
    table = table_of("part", "what", ">measured", "goal", "met")
    for goal in results["goals"]:
        verdict = "yes" if goal["met"] else "NO"
        table.add_row(goal["part"], goal["what"], f"{goal['measured']:.3g}", goal["goal"], verdict)
    console.print(table)
    loads = ", ".join(f"{part} {results[part]['load_average']:.1f}" for part in PARTS if part in results)
    console.print(f"Load average: {loads}. Everything measured: studio bench --json")
    for part, why in failed.items():
        console.print(f"{part} failed: {why}", style="red", markup=False, soft_wrap=True)
    return bool(failed)
