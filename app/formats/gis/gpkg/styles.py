"""QGIS styles of the tables: arrows along edges, red zones, quiet rooms and aisles, a dashed fence."""

from __future__ import annotations

from collections.abc import Mapping

from app.model.areas import AREA_COLOUR, AREA_KINDS, AREA_OPACITY

_ARROW = (
    "line",
    "ArrowLine",
    {
        "arrow_width": "0.4",
        "arrow_width_unit": "MM",
        "arrow_start_width": "0.4",
        "arrow_start_width_unit": "MM",
        "head_length": "2",
        "head_length_unit": "MM",
        "head_thickness": "1",
        "head_thickness_unit": "MM",
        "head_type": "0",
        "arrow_type": "0",
        "is_curved": "0",
        "is_repeated": "1",
    },
)


def _fill(colour: str, outline: str, kind: str = "solid") -> tuple[str, str, dict[str, str]]:
    colours = {"color": colour, "outline_color": outline, "outline_style": kind}
    return "fill", "SimpleFill", {**colours, "outline_width": "0.5", "outline_width_unit": "MM", "style": "solid"}


STYLES: Mapping[str, tuple[str, str, dict[str, str]]] = {
    "edges": _ARROW,
    "fence": _fill("0,0,0,0", "0,110,110,255", "dash"),
    "nodes": ("marker", "SimpleMarker", {"name": "circle", "color": "0,150,136,255", "size": "2.4", "size_unit": "MM"}),
    "zones": _fill("211,47,47,70", "211,47,47,255"),
}
"""Symbol type, class of its layer and the layer's properties, by table."""

_RGB = ",".join(map(str, AREA_COLOUR))
KINDS: Mapping[str, Mapping[str, tuple[str, str, dict[str, str]]]] = {
    "zones": dict.fromkeys(AREA_KINDS, _fill(f"{_RGB},{round(255 * AREA_OPACITY)}", f"{_RGB},255")),
}
"""Further symbols for values of ``kind``, by table."""


def style(table: str) -> str:
    """Return a table's style as QML."""
    kinds = KINDS.get(table, {})
    symbols = [_symbol(number, shape) for number, shape in enumerate([STYLES[table], *kinds.values()])]
    head = 'type="singleSymbol"'
    categories = ""
    if kinds:
        head = 'type="categorizedSymbol" attr="kind"'
        rows = [*enumerate(kinds, 1), (0, "")]  # the empty value stands for all others
        listed = (f'<category value="{k}" label="{k or "other"}" symbol="{n}" render="true"/>' for n, k in rows)
        categories = f"<categories>{''.join(listed)}</categories>"
    return (
        '<!DOCTYPE qgis PUBLIC "http://mrcc.com/qgis.dtd" "SYSTEM">'
        '<qgis version="3.22" styleCategories="Symbology">'
        f'<renderer-v2 {head} symbollevels="0" enableorderby="0" forceraster="0">{categories}'
        f"<symbols>{''.join(symbols)}</symbols></renderer-v2></qgis>"
    )


def _symbol(number: int, shape: tuple[str, str, dict[str, str]]) -> str:
    kind, name, properties = shape
    arrow = ""
    if name == "ArrowLine":
        colours = '<prop k="color" v="0,150,136,255"/><prop k="outline_style" v="no"/><prop k="style" v="solid"/>'
        arrow = (
            '<symbol name="@0@0" type="fill" alpha="1" clip_to_extent="1" force_rhr="0">'
            f'<layer class="SimpleFill" enabled="1" locked="0" pass="0">{colours}</layer></symbol>'
        )
    listed = "".join(f'<prop k="{key}" v="{value}"/>' for key, value in sorted(properties.items()))
    return (
        f'<symbol name="{number}" type="{kind}" alpha="1" clip_to_extent="1" force_rhr="0">'
        f'<layer class="{name}" enabled="1" locked="0" pass="0">{listed}{arrow}</layer></symbol>'
    )
