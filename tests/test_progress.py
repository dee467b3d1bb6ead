"""Steps that conversions report to who waits for them."""

from __future__ import annotations

from app import progress
from app.convert.files import offline
from app.progress import Progress
from tests.api import samples


def test_conversion_reports_its_steps_in_order() -> None:
    reports: list[Progress] = []
    with progress.sent_to(reports.append):
        offline({"n.tmap2.yaml": samples.tmap2()}, "occupancy_grid")
    assert [one.step for one in reports] == ["topology_to_occupancy", "writing occupancy_grid"]
    fractions = [one.fraction for one in reports]
    assert fractions == sorted(fractions)
    assert 0 < fractions[0] < fractions[-1] < 1
    offline({"n.tmap2.yaml": samples.tmap2()}, "occupancy_grid")
    assert len(reports) == 2, "nobody is told afterwards"
