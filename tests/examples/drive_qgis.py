"""Run the algorithms of examples/qgis in QGIS's own Python; print their results as JSON."""

import json
import sys
from typing import Any

from qgis.core import (
    QgsApplication,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsRasterLayer,
    QgsUnitTypes,
    QgsVectorLayer,
)

plugin_folder, photograph, empty, out = sys.argv[1:]
application = QgsApplication([], False)
application.initQgis()
sys.path[:0] = [plugin_folder, QgsApplication.pkgDataPath() + "/python/plugins"]

import processing  # noqa: E402 - one of QGIS's plugins
from processing.core.Processing import Processing  # noqa: E402
from vehanchor_provider import classFactory  # noqa: E402

Processing.initialize()
plugin = classFactory(None)
plugin.initProcessing()
algorithms = sorted(algorithm.id() for algorithm in plugin.provider.algorithms())
results: dict[str, Any] = {"algorithms": algorithms}
results["scale"] = processing.run(
    "vehanchor:scale", {"IMAGE": photograph, "BOXES": "TEMPORARY_OUTPUT"}
)
layer = QgsVectorLayer(results["scale"]["BOXES"], "boxes", "ogr")
results["boxes"] = [layer.isValid(), layer.featureCount()]
results["raster"] = processing.run(
    "vehanchor:localmetres", {"IMAGE": photograph, "RASTER": out + "/metres.tif"}
)
metres = QgsRasterLayer(results["raster"]["RASTER"], "metres")
results["layer"] = {
    "unit": QgsUnitTypes.toString(metres.crs().mapUnits()),
    "unit_per_px": metres.rasterUnitsPerPixelX(),
}
results["by height"] = processing.run("vehanchor:scale", {"IMAGE": empty, "HEIGHT": 100.0})
try:
    processing.run("vehanchor:localmetres", {"IMAGE": empty, "RASTER": out + "/none.tif"})
except QgsProcessingException as error:
    results["refused"] = str(error)
cancelled = QgsProcessingFeedback()
cancelled.cancel()
try:
    processing.run("vehanchor:scale", {"IMAGE": photograph}, feedback=cancelled)
except QgsProcessingException as error:
    results["cancelled"] = str(error)
plugin.unload()
print(json.dumps(results))
