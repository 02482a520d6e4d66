"""Plugin and Processing provider."""

from qgis.core import QgsApplication, QgsProcessingProvider

from .algorithms import EstimateScale, LocalMetres


class VehAnchorProvider(QgsProcessingProvider):
    """Provider of the algorithms."""

    def id(self):
        """Name of the provider in algorithm names."""
        return "vehanchor"

    def name(self):
        """Displayed name."""
        return "VehAnchor"

    def supportedOutputVectorLayerExtensions(self):  # noqa: N802 - QGIS's name
        """Write GeoJSON, the format of the command."""
        return ["geojson"]

    def defaultVectorFileExtension(self, hasGeometry=True):  # noqa: ARG002, N802, N803 - QGIS's names
        """Name temporary layers with the suffix of GeoJSON."""
        return "geojson"

    def loadAlgorithms(self):  # noqa: N802 - QGIS's name
        """Add the algorithms."""
        self.addAlgorithm(EstimateScale())
        self.addAlgorithm(LocalMetres())


class VehAnchorPlugin:
    """Plugin, for QGIS and for ``qgis_process``."""

    def __init__(self):
        self.provider = None

    def initProcessing(self):  # noqa: N802 - QGIS's name
        """Register the provider."""
        self.provider = VehAnchorProvider()
        QgsApplication.processingRegistry().addProvider(self.provider)

    def initGui(self):  # noqa: N802 - QGIS's name
        """Load the plugin: register the provider."""
        self.initProcessing()

    def unload(self):
        """Unload the plugin."""
        QgsApplication.processingRegistry().removeProvider(self.provider)
