"""Two algorithms that run the command ``vehanchor``.

QGIS's own Python does not need VehAnchor. The command is a program on the PATH, or the one that the
environment variable ``VEHANCHOR`` names.
"""

import json
import os
import shutil
import subprocess

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

# Exit status of the command for an unusable scale.
NOT_OK = 3
# Interval of checks for cancellation.
POLL_S = 0.2


class _Command(QgsProcessingAlgorithm):
    """Algorithm that runs the command."""

    IMAGE = "IMAGE"
    REGION = "REGION"
    HEIGHT = "HEIGHT"

    def createInstance(self):  # noqa: N802 - QGIS's name
        """Create another instance."""
        return type(self)()

    def group(self):
        """Return no group: there are only two algorithms."""
        return ""

    def groupId(self):  # noqa: N802 - QGIS's name
        """Return no group."""
        return ""

    def add_parameters(self):
        """Declare the image, the region and the height."""
        self.addParameter(QgsProcessingParameterFile(self.IMAGE, "Photograph"))
        self.addParameter(
            QgsProcessingParameterString(self.REGION, "Region, such as europe", optional=True)
        )
        height = QgsProcessingParameterNumber(
            self.HEIGHT,
            "Camera height above ground, m",
            QgsProcessingParameterNumber.Double,
            optional=True,
        )
        self.addParameter(height)

    def arguments(self, parameters, context):
        """Build the command's arguments."""
        words = [self.parameterAsFile(parameters, self.IMAGE, context)]
        region = self.parameterAsString(parameters, self.REGION, context)
        if region:
            words += ["--region", region]
        if parameters.get(self.HEIGHT) is not None:
            height = self.parameterAsDouble(parameters, self.HEIGHT, context)
            words += ["--height", str(height)]
        return words

    def run_command(self, words, feedback):
        """Run the command; return stdout, stderr and exit status.

        Raises:
            QgsProcessingException: the command is missing, fails, or is cancelled.
        """
        program = os.environ.get("VEHANCHOR") or shutil.which("vehanchor")
        if program is None:
            raise QgsProcessingException(
                "command vehanchor not found: pip install '.[geo]' in a clone, or set the variable "
                "VEHANCHOR"
            )
        # PYTHONHOME and PYTHONPATH belong to QGIS's own Python.
        environment = {
            name: value for name, value in os.environ.items() if not name.startswith("PYTHON")
        }
        running = subprocess.Popen(
            [program, *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            env=environment,
        )
        output, errors = self.wait(running, feedback)
        feedback.pushInfo(errors.strip())
        if feedback.isCanceled():
            raise QgsProcessingException("cancelled")
        if running.returncode not in (0, NOT_OK):
            reason = errors.strip() or f"vehanchor ended with status {running.returncode}"
            raise QgsProcessingException(reason)
        return output, errors, running.returncode

    def wait(self, running, feedback):
        """Return both streams when the command ends or is cancelled."""
        while True:
            try:
                return running.communicate(timeout=POLL_S)
            except subprocess.TimeoutExpired:
                if feedback.isCanceled():
                    running.terminate()


class EstimateScale(_Command):
    """Algorithm that estimates metres per pixel, and makes a layer of the vehicles."""

    BOXES = "BOXES"

    def name(self):
        """Return the algorithm's name, which follows the provider's."""
        return "scale"

    def displayName(self):  # noqa: N802 - QGIS's name
        """Return the displayed name."""
        return "Estimate the scale of a photograph"

    def shortHelpString(self):  # noqa: N802 - QGIS's name
        """Return the help text."""
        return (
            "Measures metres per pixel from the cars in an aerial photograph. Use the scale only "
            "with status ok. The vehicles have map coordinates if the file is georeferenced, "
            "otherwise pixels, y down."
        )

    def initAlgorithm(self, configuration=None):  # noqa: ARG002, N802 - QGIS's name
        """Declare parameters and outputs."""
        self.add_parameters()
        boxes = QgsProcessingParameterVectorDestination(
            self.BOXES,
            "Vehicles",
            QgsProcessing.TypeVectorPolygon,
            optional=True,
            createByDefault=False,
        )
        self.addParameter(boxes)
        self.addOutput(QgsProcessingOutputNumber("GSD", "Metres per pixel"))
        self.addOutput(QgsProcessingOutputNumber("CONFIDENCE", "Confidence"))
        self.addOutput(QgsProcessingOutputString("STATUS", "Status"))

    def processAlgorithm(self, parameters, context, feedback):  # noqa: N802 - QGIS's name
        """Run the algorithm."""
        boxes = None
        words = ["estimate", *self.arguments(parameters, context), "--json"]
        if parameters.get(self.BOXES):
            boxes = self.parameterAsOutputLayer(parameters, self.BOXES, context)
            words += ["--boxes", boxes]
        output, _, _ = self.run_command(words, feedback)
        record = json.loads(output)
        return {
            "GSD": record["gsd_m_per_px"],
            "CONFIDENCE": record["confidence"],
            "STATUS": record["status"],
            self.BOXES: boxes,
        }


class LocalMetres(_Command):
    """Algorithm that writes the photograph as a raster in local metres."""

    RASTER = "RASTER"

    def name(self):
        """Return the algorithm's name, which follows the provider's."""
        return "localmetres"

    def displayName(self):  # noqa: N802 - QGIS's name
        """Return the displayed name."""
        return "Photograph in local metres"

    def shortHelpString(self):  # noqa: N802 - QGIS's name
        """Return the help text."""
        return "Writes a GeoTIFF with the estimated pixel size and the upper left corner at 0, 0."

    def initAlgorithm(self, configuration=None):  # noqa: ARG002, N802 - QGIS's name
        """Declare parameters and outputs."""
        self.add_parameters()
        self.addParameter(
            QgsProcessingParameterRasterDestination(self.RASTER, "Photograph in local metres")
        )

    def processAlgorithm(self, parameters, context, feedback):  # noqa: N802 - QGIS's name
        """Run the algorithm."""
        raster = self.parameterAsOutputLayer(parameters, self.RASTER, context)
        words = ["estimate", *self.arguments(parameters, context), "--geotiff", raster]
        _, errors, status = self.run_command(words, feedback)
        if status == NOT_OK:
            reason = errors.strip() or "see the log"
            raise QgsProcessingException(f"the scale is not usable: {reason}")
        return {self.RASTER: raster}
