"""Template sets have values that writers accept; a format's values follow from set and environment."""

from __future__ import annotations

import pytest

from app import formats, parameters, templates
from app.convert.files import offline
from app.errors import Invalid
from app.formats import FileGroup, ReadContext
from app.model.features import Features
from app.model.frame import Datum
from app.model.layers import Layers
from app.model.templates import NO_TEMPLATES, FormatTemplate, Templates, template_changes
from app.upload_reader import UploadHints

TMAP2 = formats.get_format("tmap2")


@pytest.mark.parametrize("name", templates.SETS)
def test_template_sets_have_only_valid_values(name: str) -> None:
    one = templates.SETS[name]
    assert one.title
    for format_name, values in one.values.items():
        assert values, format_name
        checked = templates.check_values(formats.get_format(format_name), values)
        assert checked == dict(sorted(values.items())), f"{format_name}: values must have their stored form"
        defaults = {p["name"]: p["default"] for p in parameters.describe(formats.get_format(format_name).write_options)}
        same = [key for key, value in checked.items() if value == defaults[key]]
        assert not same, f"{format_name}: {same} repeat the format's own defaults"


def test_names_are_unambiguous() -> None:
    """``set`` is beside names of formats and parameters in a version's changes."""
    assert "set" not in formats.all_formats()
    for fmt in formats.all_formats().values():
        assert "set" not in {p["name"] for p in parameters.describe(fmt.write_options)}


def test_resolved_template_follows_set_and_environment() -> None:
    assert templates.resolve(NO_TEMPLATES, TMAP2) is templates.NO_VALUES
    environment_templates = Templates(
        "outdoor",
        {"tmap2": FormatTemplate(None, {"xy_goal_tolerance": 0.4}), "lif": FormatTemplate(None, {"creator": "x"})},
    )
    resolved_template = templates.resolve(environment_templates, TMAP2)
    assert resolved_template.values["xy_goal_tolerance"] == 0.4
    assert resolved_template.origin["xy_goal_tolerance"] == templates.ENVIRONMENT
    assert resolved_template.origin["verts_radius"] == "set outdoor"
    assert "action" not in resolved_template.values
    assert resolved_template.ignored == ()
    updated_templates = templates.with_format_template(environment_templates, "tmap2", FormatTemplate("default"))
    assert templates.resolve(updated_templates, TMAP2).values == {}, "the default set on purpose"
    assert templates.with_format_template(updated_templates, "tmap2", FormatTemplate()).formats.keys() == {"lif"}
    assert Templates.from_dict(environment_templates.as_dict()) == environment_templates
    assert Templates.from_dict({}) == NO_TEMPLATES
    assert Templates("default", {"tmap2": FormatTemplate()}) == NO_TEMPLATES
    assert hash(Templates("default", {"tmap2": FormatTemplate()})) == hash(NO_TEMPLATES)
    assert Templates("indoor") != NO_TEMPLATES


def test_template_changes_lists_differing_values() -> None:
    a = Templates("default", {"tmap2": FormatTemplate(None, {"action": "go", "osm": False})})
    b = Templates(
        "indoor",
        {
            "tmap2": FormatTemplate("ros2", {"action": "run", "osm": False}),
            "lif": FormatTemplate(None, {"creator": "x"}),
        },
    )
    assert template_changes(a, a) == {}
    assert template_changes(a, b) == {
        "templates": {
            "set": {"from": "default", "to": "indoor"},
            "lif": {"creator": {"from": None, "to": "x"}},
            "tmap2": {"set": {"from": None, "to": "ros2"}, "action": {"from": "go", "to": "run"}},
        }
    }
    none = Templates("default", {"tmap2": FormatTemplate(None, {"action": "go", "osm": False, "pointset": None})})
    assert template_changes(a, none) == {"templates": {"tmap2": {"pointset": {"from": None, "to": None}}}}


def test_values_have_json_types() -> None:
    octomap = formats.get_format("octomap")
    assert templates.check_values(octomap, {"bbox": "0,0,0,1,1,1"}) == {"bbox": [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]}
    assert templates.check_values(TMAP2, {"xy_goal_tolerance": "0.5", "osm": "yes"}) == {
        "osm": True,
        "xy_goal_tolerance": 0.5,
    }
    with pytest.raises(Invalid) as caught:
        templates.check_values(TMAP2, {"xy_goal_tolerance": -1, "colour": 2})
    assert {p.where for p in caught.value.problems} == {"values.xy_goal_tolerance", "values.colour"}


EVIL = "\"'<&>: {[#%!]} ]]>--\\ äß"
LANE = b"""<kml xmlns="http://www.opengis.net/kml/2.2"><Document><name>lanes</name><Placemark><name>Lane</name>
<LineString><coordinates>-0.5245,53.2686 -0.5244,53.2686 -0.5244,53.2687</coordinates></LineString></Placemark>
</Document></kml>"""


def texts(fmt: formats.Format) -> dict[str, str]:
    """List a writer's parameters that accept any text and select no stored part."""
    choosing = {"grid", "level", "name", "picture", "world"}
    described = parameters.describe(fmt.write_options)
    return {p["name"]: EVIL for p in described if p["schema"] == {"type": "string"} and p["name"] not in choosing}


WITH_TEXTS = [fmt.name for fmt in formats.all_formats().values() if texts(fmt)]


@pytest.mark.parametrize("name", WITH_TEXTS)
def test_text_values_are_escaped_in_files(name: str) -> None:
    fmt = formats.get_format(name)
    options = templates.check_values(fmt, texts(fmt))
    hints, datum = UploadHints(layer="topology"), Datum(53.2686, -0.5245)
    converted = offline({"lanes.kml": LANE}, name, hints=hints, datum=datum, options=options)
    main = next(iter(converted.files))
    back = formats.read(FileGroup(fmt, main, converted.files), ReadContext(frame=Layers({}, datum).frame))
    content = str([(p.ids, p.properties, p.document) for p in back.parts.values() if isinstance(p, Features)])
    filled = {line["option"] for line in converted.report.as_dict()["template"] if line.get("option") in options}
    assert filled
    assert {line["from"] for line in converted.report.as_dict()["template"] if line.get("option") in filled} == {
        "request"
    }
    assert content.count(repr(EVIL)[1:-1]) >= 1, "the complete text is in the file"
