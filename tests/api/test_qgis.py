"""QGIS opens the demo by one address, draws it, and edits its network through a draft.

``QGIS_PICTURES=docs/images`` keeps the two images of docs/how-to/qgis.md.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from app.cli import demo
from app.cli.client import Client
from tests import qgis
from tests.api.conftest import ADMIN, Api, create_farm, running, settings_for
from tests.api.test_ogc_clients import metres_apart

CONNECT = """
import base64
url, password, picture = sys.argv[1:]
for key, value in {"url": url, "version": "OGC_API_FEATURES", "username": "any", "password": password}.items():
    QgsSettings().setValue(f"connections/ows/items/wfs/connections/items/site/{key}", value)

def sign_in(request):  # without a screen nobody answers QGIS' question for a password when it opens layers.qlr
    request.setRawHeader(b"Authorization", b"Basic " + base64.b64encode(f"any:{password}".encode()))

def listed():  # the address' layers, as the browser of QGIS shows them
    (site,) = QgsApplication.dataItemProviderRegistry().provider("WFS").createDataItem("", None).createChildren()
    return {item.name(): QgsVectorLayer(item.uri(), item.name(), "OAPIF") for item in site.createChildren()}

def open_styled():  # drags layers.qlr onto the map
    from qgis.PyQt.QtCore import QUrl
    from qgis.PyQt.QtNetwork import QNetworkRequest
    QgsNetworkAccessManager.setRequestPreprocessor(sign_in)
    definition = QgsNetworkAccessManager.blockingGet(QNetworkRequest(QUrl(url + "layers.qlr"))).content()
    with open(os.environ["HOME"] + "/layers.qlr", "wb") as file:
        file.write(bytes(definition))
    project = QgsProject.instance()
    opened, problem = QgsLayerDefinition.loadLayerDefinition(file.name, project, project.layerTreeRoot())
    return opened, problem, list(project.layerTreeRoot().layerOrder())

def draw(layers, extent, title):
    from qgis.PyQt.QtCore import QSize, Qt, QSizeF
    from qgis.PyQt.QtGui import QColor, QFont, QImage, QPainter
    settings = QgsMapSettings()
    settings.setLayers(layers)
    settings.setDestinationCrs(QgsCoordinateReferenceSystem("EPSG:32631"))
    settings.setTransformContext(QgsProject.instance().transformContext())
    settings.setOutputSize(QSize(900, 560))
    settings.setOutputDpi(96)
    settings.setBackgroundColor(QColor("white"))
    degrees = QgsCoordinateReferenceSystem("EPSG:4326")
    to = QgsCoordinateTransform(degrees, settings.destinationCrs(), QgsProject.instance())
    settings.setExtent(to.transformBoundingBox(extent))
    job = QgsMapRendererParallelJob(settings)
    job.start()
    job.waitForFinished()
    errors = [error.message for error in job.errors()]
    image = QImage(1160, 560, QImage.Format.Format_RGB32)
    image.fill(QColor("#f4f4f4"))
    painter = QPainter(image)
    painter.drawImage(260, 0, job.renderedImage())
    painter.setFont(QFont("DejaVu Sans", 9))
    painter.drawText(12, 24, title)
    for row, layer in enumerate(layers):
        painter.drawText(12, 54 + 24 * row, f"☑ {layer.name()}")
    painter.end()
    image.save(picture)
    return errors
"""

OPEN = """
layers = listed()
counts = {name: layer.featureCount() for name, layer in layers.items() if layer.isValid()}
opened, problem, styled = open_styled()
extent = layers["Fence"].extent()
extent.scale(1.05)
errors = draw(styled, extent, "Demo orchard")
valid = [one.isValid() for one in styled]
answer({"counts": counts, "opened": opened, "problem": problem, "valid": valid, "errors": errors})
"""

EDIT = """
layers = listed()
edges, nodes = layers["Edges"], layers["Nodes"]

def saved(layer):
    done = layer.commitChanges()
    return None if done else layer.commitErrors()

def find(layer, id):
    return next(f for f in layer.getFeatures() if f["id"] == id)

problems = []
edges.startEditing()
edge = find(edges, "Dock1_Yard1")
line = edge.geometry().asPolyline()
bend = QgsPointXY((line[0].x() + line[-1].x()) / 2 + 2e-5, (line[0].y() + line[-1].y()) / 2)
edges.changeGeometry(edge.id(), QgsGeometry.fromPolylineXY([line[0], bend, line[-1]]))
edges.changeAttributeValue(edge.id(), edges.fields().indexOf("speed_limit"), 0.7)
problems.append(saved(edges))

dock = find(nodes, "Dock1").geometry().asPoint()
place = QgsPointXY(dock.x() + 1e-4, dock.y() + 1e-4)
nodes.startEditing()
node = QgsFeature(nodes.fields())
node.setAttribute("name", "from QGIS")
node.setGeometry(QgsGeometry.fromPointXY(place))
nodes.addFeature(node)
problems.append(saved(nodes))

edges.startEditing()
for end in (place, find(nodes, "Yard1").geometry().asPoint()):
    road = QgsFeature(edges.fields())
    road.setGeometry(QgsGeometry.fromPolylineXY([dock, end]))
    edges.addFeature(road)
    if end == place:
        problems.append(saved(edges))
        edges.startEditing()
edges.rollBack()
after = sorted(f["id"] for f in layers["Edges"].getFeatures())
_, _, styled = open_styled()
extent = QgsRectangle(dock, place)
extent.combineExtentWith(bend)
extent.scale(2)
errors = draw(styled, extent, "Demo orchard, draft mine")
drawn = {"bend": [bend.x(), bend.y()], "node": [place.x(), place.y()]}
answer({"problems": problems, "errors": errors, "edges": after, **drawn})
"""

FIRST = """
layers = listed()
zones = layers["Zones"]
kinds = {name: QgsWkbTypes.displayString(layer.wkbType()) for name, layer in layers.items()}
before = [zones.featureCount(), len(list(zones.getFeatures()))]
zones.startEditing()
zone = QgsFeature(zones.fields())
zone.setAttribute("kind", "keepout")
zone.setAttribute("name", "pond")
middle = next(layers["Nodes"].getFeatures()).geometry().asPoint()
zone.setGeometry(QgsGeometry.fromRect(QgsRectangle(middle.x(), middle.y(), middle.x() + 1e-4, middle.y() + 1e-4)))
added = zones.addFeature(zone)
problems = None if zones.commitChanges() else zones.commitErrors()
again = listed()["Zones"]
after = [[f["id"], f["kind"], round(f.geometry().area() * 1e8, 3)] for f in again.getFeatures()]
fields = [field.name() for field in zones.fields()]
answer({"kinds": kinds, "fields": fields, "before": before, "added": added, "problems": problems, "after": after})
"""


@pytest.fixture(scope="module")
def orchard(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    """Run a server with the demo."""
    with running(settings_for(tmp_path_factory.mktemp("qgis"))) as api:
        with Client(api.url, ADMIN) as client:
            demo.install(client)
        yield api


def keep(picture: Path) -> None:
    """Keep the image for the documentation if asked to."""
    if folder := os.environ.get("QGIS_PICTURES"):
        Image.open(picture).quantize(64).save(Path(folder) / picture.name, optimize=True)


def test_qgis_opens_the_demo_by_one_address(orchard: Api, tmp_path: Path) -> None:
    picture = tmp_path / "qgis-site.png"
    result = qgis.run(CONNECT + OPEN, f"{orchard.url}/ogc/orchard/", ADMIN, picture, folder=tmp_path)
    listed = orchard.get("/ogc/orchard/collections").json()["collections"]
    items = {one["title"]: f"/ogc/orchard/collections/{one['id']}/items" for one in listed if one.get("itemType")}
    expected = {title: orchard.get(path, params={"limit": 1}).json()["numberMatched"] for title, path in items.items()}
    assert {name: result["counts"][name] for name in expected} == expected
    assert (result["opened"], result["problem"], result["errors"]) == (True, "", [])
    assert all(result["valid"])
    pixels = np.array(Image.open(picture).convert("RGB"))[:, 260:]
    assert (pixels.min(axis=2) < 240).mean() > 0.4, "the satellite image is drawn below the network"
    keep(picture)


def test_qgis_edits_the_network_through_a_draft(orchard: Api, tmp_path: Path) -> None:
    picture = tmp_path / "qgis-edit.png"
    result = qgis.run(CONNECT + EDIT, f"{orchard.url}/ogc/orchard/drafts/mine/", ADMIN, picture, folder=tmp_path)
    assert result["problems"] == [None, None, None]
    assert result["errors"] == []
    assert "Dock1_from QGIS" in result["edges"]
    (draft,) = orchard.get("environments/orchard/drafts").json()
    assert draft["changes"] == {"topology": {"added": 2, "changed": 1, "deleted": 0}}
    before = orchard.get("/ogc/orchard/collections/edges/items/Dock1_Yard1").json()
    assert before["properties"]["speed_limit"] != 0.7, "an edit is not in the head"
    commit = f"environments/orchard/drafts/{draft['id']}/commit"
    version = orchard.post(commit, {"message": "QGIS"}, headers={"if-match": f'"{draft["base"]}"'}).json()
    assert version["message"] == "QGIS"
    edge = orchard.get("/ogc/orchard/collections/edges/items/Dock1_Yard1").json()
    node = orchard.get("/ogc/orchard/collections/nodes/items/from%20QGIS").json()
    assert edge["properties"]["speed_limit"] == 0.7
    assert metres_apart(np.array([edge["geometry"]["coordinates"][1]]), np.array([result["bend"]])) < 1e-3
    # QGIS rounds the positions of new features to 6 decimals of a degree.
    assert metres_apart(np.array([node["geometry"]["coordinates"]]), np.array([result["node"]])) < 0.1
    keep(picture)


def test_qgis_draws_the_first_zone_of_a_site_into_a_draft(orchard: Api, tmp_path: Path) -> None:
    """QGIS 3.40 takes type and fields from features, 3.44 from the schema: both know them without a feature."""
    farm = create_farm(orchard, "first-zone")
    result = qgis.run(
        CONNECT + FIRST, f"{orchard.url}/ogc/{farm}/drafts/mine/", ADMIN, tmp_path / "none.png", folder=tmp_path
    )
    assert (result["kinds"]["Zones"], result["kinds"]["Fence"]) == ("Polygon", "Polygon")
    assert (result["kinds"]["Objects: points"], result["kinds"]["Objects: lines"]) == ("Point", "LineString")
    assert {"kind", "name", "level", "part"} <= set(result["fields"])
    assert (result["before"], result["added"], result["problems"]) == ([0, 0], True, None)
    assert result["after"] == [["pond", "keepout", 1.0]]
    (draft,) = orchard.get(f"environments/{farm}/drafts").json()
    commit = f"environments/{farm}/drafts/{draft['id']}/commit"
    orchard.post(commit, {"message": "pond"}, headers={"if-match": f'"{draft["base"]}"'})
    (zone,) = orchard.get(f"/ogc/{farm}/collections/zones/items").json()["features"]
    assert (zone["id"], zone["geometry"]["type"], zone["properties"]["kind"]) == ("pond", "Polygon", "keepout")
