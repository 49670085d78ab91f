"""Depth sensors that can be bought: pixels, field of view, range and noise, as their vendors' data sheets have them.

Figures are of the vendors' public data sheets as remembered, without the sheets at hand, but for what ``checked``
names; put your own device's into the object's file where they are better known. Focal lengths follow from the field of
view at the best distance; noise is given there and grows with the square of the distance.
"""

from __future__ import annotations

from dataclasses import dataclass

from attentionvote.simulation.camera import Camera
from attentionvote.simulation.sensor import Sensor

CUSTOM = "custom"  # a camera of the user's, from a file
_NOISE_DISTANCE = 0.65  # of Sensor.axial_sigma_mm, metres


@dataclass(frozen=True)
class SensorModel:
    """A depth sensor as its data sheet describes it.

    Attributes:
        title: for people.
        sheet: where the figures are from.
        checked: which of them were compared with a public page of the vendor's; the others were not.
        pixels: width and height of the depth image.
        near, best, far: nearest, best and farthest distance in metres.
        field: width in metres of what the picture shows at the best distance.
        noise_mm: standard deviation along the ray at the best distance, millimetres.
        baseline: metres from camera to projector, or to the second camera.
        noise_pixels: over which noise is alike.
    """

    title: str
    sheet: str
    checked: str
    pixels: tuple[int, int]
    near: float
    best: float
    far: float
    field: float
    noise_mm: float
    baseline: float
    noise_pixels: float = 0.0

    @property
    def camera(self) -> Camera:
        """Pinhole intrinsics, square pixels, the principal point in the middle."""
        width, height = self.pixels
        focal = round(width * self.best / self.field, 1)
        return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)

    @property
    def sensor(self) -> Sensor:
        """What it measures: the structured-light preset with this device's lengths."""
        sigma = round(self.noise_mm * (_NOISE_DISTANCE / self.best) ** 2, 4)
        return Sensor(
            "phoxi", axial_sigma_mm=sigma, baseline=self.baseline, scaled=False, noise_pixels=self.noise_pixels
        )

    def noise(self, distance: float) -> float:
        """Standard deviation in metres of points at ``distance`` metres, seen straight on."""
        return self.noise_mm / 1000 * (distance / self.best) ** 2


_PHOXI = "projection angle of 47.5 degrees, wiki.photoneo.com, PhoXi 3D scanners family"
# Smallest first: the first whose picture holds the bin is the default. Small ones measure best.
SENSOR_MODELS = {
    "phoxi_s": SensorModel(
        "Photoneo PhoXi 3D Scanner S",
        "PhoXi 3D Scanner S data sheet, 2021: 384 to 520 mm, best 442 mm, 0.174 mm a point",
        _PHOXI, (2064, 1544), 0.384, 0.442, 0.520, 0.360, 0.05, 0.230,
    ),
    "phoxi_m": SensorModel(
        "Photoneo PhoXi 3D Scanner M",
        "PhoXi 3D Scanner M data sheet, 2021: 458 to 1118 mm, best 650 mm, 0.286 mm a point",
        _PHOXI, (2064, 1544), 0.458, 0.650, 1.118, 0.590, 0.10, 0.270,
    ),
    "phoxi_l": SensorModel(
        "Photoneo PhoXi 3D Scanner L",
        "PhoXi 3D Scanner L data sheet, 2021: 780 to 2150 mm, best 1239 mm, 0.524 mm a point",
        _PHOXI, (2064, 1544), 0.780, 1.239, 2.150, 1.082, 0.19, 0.550,
    ),
    # The vendor's 2+ family has M60, M130 and L110; the model with its focus at 700 mm is the Zivid 2 M70.
    "zivid_m70": SensorModel(
        "Zivid 2 M70",
        "Zivid 2 M70 data sheet, 2022: 300 to 1300 mm, focus 700 mm, 754 mm wide there, precision 0.055 mm",
        "1944 x 1200 points, support.zivid.com, sampling", (1944, 1200), 0.300, 0.700, 1.300, 0.754, 0.055, 0.110,
    ),
    # Active stereo, at the pixels that the vendor recommends. Noise: 0.08 pixels of disparity at 427 pixels and 50 mm,
    # over windows of about five pixels.
    "realsense_d435": SensorModel(
        "Intel RealSense D435", "Intel RealSense D400 series data sheet 337029, 2020: baseline 50 mm, 0.28 to 3 m; "
        "noise by Intel's tuning guide, subpixel error 0.08",
        "848 x 480 recommended, some 90 x 58 degrees, 645 pixels of focal length at 1280 x 720: dev.intelrealsense.com",
        (848, 480), 0.280, 0.500, 3.000, 0.993, 0.937, 0.050, 5.0,
    ),
}  # fmt: skip
