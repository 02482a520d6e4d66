"""Two algorithms, each a call of the command ``vehanchor``.

QGIS has a Python of its own, in which VehAnchor need not be: the command is a program, found on the path or named by
the environment variable ``VEHANCHOR``.
"""

import json
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from qgis.core import (
    QgsProcessing,
    QgsProcessingAlgorithm,
    QgsProcessingException,
    QgsProcessingOutputNumber,
    QgsProcessingOutputString,
    QgsProcessingParameterFile,
    QgsProcessingParameterNumber,
    QgsProcessingParameterRasterDestination,
    QgsProcessingParameterString,
    QgsProcessingParameterVectorDestination,
)

NOT_OK = 3  # the command's status where a scale is not to be used
LOOK_EVERY_S = 0.2  # whether the user has cancelled


class _Command(QgsProcessingAlgorithm):
    """An algorithm that asks the command."""

    IMAGE, REGION, HEIGHT = "IMAGE", "REGION", "HEIGHT"

    def createInstance(self):  # noqa: N802 - QGIS calls it so
        """Another of the same."""
        return type(self)()

    def group(self):
        """No group: they are two."""
        return ""

    def groupId(self):  # noqa: N802 - QGIS calls it so
        """No group."""
        return ""

    def add_questions(self):
        """The image, and what helps to measure it."""
        self.addParameter(QgsProcessingParameterFile(self.IMAGE, "Photograph"))
        self.addParameter(QgsProcessingParameterString(self.REGION, "Region, such as europe", optional=True))
        height = QgsProcessingParameterNumber(
            self.HEIGHT, "Camera's height above the ground, m", QgsProcessingParameterNumber.Double, optional=True
        )
        self.addParameter(height)

    def arguments(self, parameters, context):
        """The image and the options that were answered."""
        region = self.parameterAsString(parameters, self.REGION, context)
        words = [self.parameterAsFile(parameters, self.IMAGE, context)]
        words += ["--region", region] if region else []
        if parameters.get(self.HEIGHT) is not None:
            words += ["--height", str(self.parameterAsDouble(parameters, self.HEIGHT, context))]
        return words

    def ask(self, words, feedback):
        """Run the command; what it prints, what it says beside it, and its status."""
        program = os.environ.get("VEHANCHOR") or shutil.which("vehanchor")
        if program is None:
            raise QgsProcessingException(
                "there is no command vehanchor: pip install 'vehanchor[geo]', or name it by the variable VEHANCHOR"
            )
        # PYTHONHOME and PYTHONPATH are those of QGIS's own Python
        environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
        running = subprocess.Popen(
            [program, *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            env=environment,
        )
        told, said = self.wait(running, feedback)
        feedback.pushInfo(said.strip())
        if feedback.isCanceled():
            raise QgsProcessingException("cancelled")
        if running.returncode not in (0, NOT_OK):
            raise QgsProcessingException(said.strip() or f"vehanchor ended with status {running.returncode}")
        return told, said, running.returncode

    def wait(self, running, feedback):
        """What the command says on both streams, once it has ended or has been cancelled."""
        while True:
            try:
                return running.communicate(timeout=LOOK_EVERY_S)
            except subprocess.TimeoutExpired:
                if feedback.isCanceled():
                    running.terminate()


class EstimateScale(_Command):
    """Metres per pixel, whether to rely on it, and the vehicles as a layer."""

    BOXES = "BOXES"

    def name(self):
        """The second half of its name."""
        return "scale"

    def displayName(self):  # noqa: N802 - QGIS calls it so
        """What people read."""
        return "Estimate the scale of a photograph"

    def shortHelpString(self):  # noqa: N802 - QGIS calls it so
        """What it does."""
        return (
            "Measures metres per pixel from the cars in an aerial photograph. Rely on it where the status is ok. The "
            "vehicles lie on the ground where the file is georeferenced, else in its pixels, y down."
        )

    def initAlgorithm(self, configuration=None):  # noqa: ARG002, N802 - QGIS calls it so
        """Declare what it takes and gives."""
        self.add_questions()
        self.addParameter(
            QgsProcessingParameterVectorDestination(
                self.BOXES, "Vehicles", QgsProcessing.TypeVectorPolygon, optional=True, createByDefault=False
            )
        )
        self.addOutput(QgsProcessingOutputNumber("GSD", "Metres per pixel"))
        self.addOutput(QgsProcessingOutputNumber("CONFIDENCE", "Confidence"))
        self.addOutput(QgsProcessingOutputString("STATUS", "Status"))

    def processAlgorithm(self, parameters, context, feedback):  # noqa: N802 - QGIS calls it so
        """Do it."""
        boxes = None
        words = ["estimate", *self.arguments(parameters, context), "--json"]
        if parameters.get(self.BOXES):
            boxes = self.parameterAsOutputLayer(parameters, self.BOXES, context)
            words += ["--boxes", boxes]
        record = json.loads(self.ask(words, feedback)[0])
        return {
            "GSD": record["gsd_m_per_px"],
            "CONFIDENCE": record["confidence"],
            "STATUS": record["status"],
            self.BOXES: boxes,
        }


class LocalMetres(_Command):
    """The photograph as a raster in which QGIS measures."""

    RASTER = "RASTER"

    def name(self):
        """The second half of its name."""
        return "localmetres"

    def displayName(self):  # noqa: N802 - QGIS calls it so
        """What people read."""
        return "Photograph in local metres"

    def shortHelpString(self):  # noqa: N802 - QGIS calls it so
        """What it does."""
        return "Writes a GeoTIFF with the estimated size of a pixel, the upper left corner at 0, 0."

    def initAlgorithm(self, configuration=None):  # noqa: ARG002, N802 - QGIS calls it so
        """Declare what it takes and gives."""
        self.add_questions()
        self.addParameter(QgsProcessingParameterRasterDestination(self.RASTER, "Photograph in local metres"))

    def processAlgorithm(self, parameters, context, feedback):  # noqa: N802 - QGIS calls it so
        """Do it."""
        raster = self.parameterAsOutputLayer(parameters, self.RASTER, context)
        with tempfile.TemporaryDirectory() as folder:
            picture = str(Path(folder) / "bar.png")
            words = ["scalebar", *self.arguments(parameters, context), "--output", picture, "--geotiff", raster]
            _, said, status = self.ask(words, feedback)
        if status == NOT_OK:
            raise QgsProcessingException(f"the scale is not to be used: {said.strip() or 'see the log'}")
        return {self.RASTER: raster}
