"""Style sheets of the page's views: each one stays loaded when another view is opened."""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path

VIEWS = Path(__file__).resolve().parents[2] / "app" / "web" / "src" / "views"


def test_views_do_not_style_each_others_classes() -> None:
    views_of_class: dict[str, set[str]] = defaultdict(set)
    for sheet in VIEWS.glob("*/*.css"):
        text = re.sub(r"/\*.*?\*/", "", sheet.read_text(), flags=re.DOTALL)
        for selectors in re.findall(r"([^{}@]+)\{", text):
            for selector in selectors.split(","):
                if name := re.match(r"\.([\w-]+)", selector.strip()):
                    views_of_class[name[1]].add(sheet.parent.name)
    assert len(views_of_class) > 50
    assert {name: sorted(views) for name, views in views_of_class.items() if len(views) > 1} == {}
