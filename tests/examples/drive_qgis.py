"""Runs the algorithms of examples/qgis without a window, in QGIS's own Python; prints what they give as JSON."""

import json
import sys
from typing import Any

from qgis.core import QgsApplication, QgsProcessingException, QgsProcessingFeedback, QgsVectorLayer

plugin_folder, photograph, nothing, out = sys.argv[1:]
application = QgsApplication([], False)
application.initQgis()
sys.path[:0] = [plugin_folder, QgsApplication.pkgDataPath() + "/python/plugins"]

import processing  # noqa: E402 - it is one of QGIS's plugins
from processing.core.Processing import Processing  # noqa: E402
from vehanchor_provider import classFactory  # noqa: E402

Processing.initialize()
plugin = classFactory(None)
plugin.initProcessing()
seen: dict[str, Any] = {"algorithms": sorted(each.id() for each in plugin.provider.algorithms())}
seen["scale"] = processing.run(
    "vehanchor:scale", {"IMAGE": photograph, "BOXES": "TEMPORARY_OUTPUT"}
)
layer = QgsVectorLayer(seen["scale"]["BOXES"], "boxes", "ogr")
seen["boxes"] = [layer.isValid(), layer.featureCount()]
seen["raster"] = processing.run(
    "vehanchor:localmetres", {"IMAGE": photograph, "RASTER": out + "/metres.tif"}
)
seen["by height"] = processing.run("vehanchor:scale", {"IMAGE": nothing, "HEIGHT": 100.0})
try:
    processing.run("vehanchor:localmetres", {"IMAGE": nothing, "RASTER": out + "/none.tif"})
except QgsProcessingException as error:
    seen["refused"] = str(error)
cancelled = QgsProcessingFeedback()
cancelled.cancel()
try:
    processing.run("vehanchor:scale", {"IMAGE": photograph}, feedback=cancelled)
except QgsProcessingException as error:
    seen["cancelled"] = str(error)
plugin.unload()
print(json.dumps(seen))
