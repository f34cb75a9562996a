"""``python -m tests.costs``: what each file of tests costs, in CONTRIBUTING.md, from the last runs' JUnit reports.

`make test` writes out/test.xml, `make test-all` out/test-all.xml. Processor time is that of the test, its fixtures and
its child processes.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

__all__ = ["main", "table"]

ROOT = Path(__file__).resolve().parent.parent
REPORTS = {"`make test`": "out/test.xml", "`make test-all`": "out/test-all.xml"}
PAGE = "CONTRIBUTING.md"
BEGIN, END = "<!-- costs -->\n", "<!-- end of costs -->\n"
LEAST = 10.0  # s of processor time of a file that has a row of its own: the others are hardly worth a look


def costs(report: Path) -> Iterator[tuple[str, float]]:
    """File and processor time (s) of each test that was run."""
    for case in ElementTree.parse(report).iter("testcase"):
        said = {p.get("name"): p.get("value") for p in case.iter("property")}
        if case.find("skipped") is None and said.get("file"):
            yield str(said["file"]), float(said["cpu_s"] or 0.0)


def table(reports: dict[str, Path]) -> str:
    """The table, the dearest files first; what is cheap is one row."""
    rings = list(reports)
    of: dict[str, list[list[float]]] = defaultdict(lambda: [[] for _ in rings])
    for i, ring in enumerate(rings):
        for file, seconds in costs(reports[ring]):
            of[Path(file).name][i].append(seconds)
    total = {file: sum(sum(each) for each in found) for file, found in of.items()}
    shown = sorted((f for f in of if total[f] >= LEAST), key=lambda f: -total[f])
    rows = {f"`{f}`": of[f] for f in shown}
    rest = [f for f in of if f not in shown]
    rows[f"{len(rest)} others"] = [[s for f in rest for s in of[f][i]] for i in range(len(rings))]
    rows["all"] = [[s for f in of for s in of[f][i]] for i in range(len(rings))]
    head = "".join(f" {ring}: tests | s |" for ring in rings)
    lines = [f"| file |{head}", "|---|" + "---|---|" * len(rings)]
    for name, found in rows.items():
        cells = "".join(f" {len(each)} | {sum(each):.0f} |" if each else " | |" for each in found)
        lines.append(f"| {name} |{cells}")
    return "\n".join(lines) + "\n"


def main() -> int:
    """Write the table into the page; 2 where a report is missing."""
    reports = {ring: ROOT / name for ring, name in REPORTS.items()}
    for ring, report in reports.items():
        if not report.is_file():
            print(f"costs: {report.relative_to(ROOT)}: not there; {ring} writes it", file=sys.stderr)
            return 2
    page = ROOT / PAGE
    before, _, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    _, _, after = rest.partition(END)
    page.write_text(f"{before}{BEGIN}{table(reports)}{END}{after}", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
