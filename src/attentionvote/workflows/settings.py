"""Settings of the verbs that are one file each: export, promote, rollback, history, generate, view and others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from attentionvote.command.configuration import VerbSettings
from attentionvote.command.sections import EXECUTOR, TRUSTED_KEY, WORKERS, Cluster, Store
from attentionvote.export.parity_record import Limits
from attentionvote.registry.gates import Rules
from attentionvote.section import Target
from attentionvote.setting import Setting
from attentionvote.simulation.scene_spec import SimulationSettings
from attentionvote.simulation.sensor import PRESETS, Sensor
from attentionvote.simulation.sensor_models import CUSTOM, SENSOR_MODELS
from attentionvote.workflows.evaluate.settings import MeasuredBundle

SPLITS = ("train", "val", "test")
WHY = Setting("Why, for the history.")
SCENE_SETS = Setting("Where scene sets are: <root>/<object>/<split>-<digest>.")


@dataclass(frozen=True, kw_only=True)
class ExportSettings(VerbSettings):
    """Which training becomes a bundle, and what its proof must hold."""

    verb: ClassVar[str] = "export"
    object: Target
    run: Annotated[
        str | None,
        Setting("Beginning of an MLflow run's id or of a folder's name; null = the newest complete training."),
    ]
    root: Annotated[str, Setting("Where scene sets and clouds lie.")]
    trained: Annotated[str, Setting("Where trainings lie.")]
    outputs: Annotated[str, Setting("Where bundles lie.")]
    scenes: Annotated[int, Setting("Held-out scenes for the proof, spread over all drop cycles.", low=1, high=100_000)]
    golden: Annotated[int, Setting("Clouds that a server tests itself with.", low=1, high=64)]
    signing_keys: Annotated[
        str | None, Setting("Folder of the signing keys; null = ATTENTIONVOTE_KEYS, else ~/.config/attentionvote.")
    ]
    triton: Annotated[str | None, Setting("Folder for a Triton model repository beside the bundle; null = none.")]
    workers: Annotated[int | None, WORKERS]
    force: Annotated[bool, Setting("Repeat an export that is done.")]
    voting_radius: Annotated[
        float | None, Setting("In which votes are gathered, metres; null = the training's.", above=0, high=10)
    ]
    peak_threshold: Annotated[float | None, Setting("Heat that a peak needs; null = the training's.", low=0, high=1000)]
    limits: Limits


@dataclass(frozen=True, kw_only=True)
class PromoteSettings(MeasuredBundle):
    """The candidate and the gates it must pass."""

    verb: ClassVar[str] = "promote"
    why: Annotated[str, WHY]
    champion_key: Annotated[
        str | None, Setting("Public key that must have signed the champion, when an older one; null = the same.")
    ]
    gates: Rules


@dataclass(frozen=True, kw_only=True)
class RollbackSettings(VerbSettings):
    """Which former champion comes back."""

    verb: ClassVar[str] = "rollback"
    object: Target
    to: Annotated[int | None, Setting("Version; null = the champion before.", low=1, high=1_000_000_000)]
    why: Annotated[str, WHY]
    trusted_key: Annotated[str | None, TRUSTED_KEY]
    tracking: Store


@dataclass(frozen=True, kw_only=True)
class ReproduceSettings(VerbSettings):
    """Which registered version is made again."""

    verb: ClassVar[str] = "reproduce"
    object: Target
    version: Annotated[int | None, Setting("Of the registry; null = the champion.", low=1, high=1_000_000_000)]
    outputs: Annotated[str, Setting("Where its data, training and comparison go.")]
    workers: Annotated[int | None, WORKERS]
    tracking: Store


@dataclass(frozen=True, kw_only=True)
class HistorySettings(VerbSettings):
    """Whose decisions are shown."""

    verb: ClassVar[str] = "history"
    object: Target
    last: Annotated[int, Setting("Show at most this many decisions, the newest.", low=1, high=1_000_000)]
    tracking: Store


@dataclass(frozen=True, kw_only=True)
class GenerateSettings(VerbSettings):
    """Which scene sets are made, and where."""

    verb: ClassVar[str] = "generate"
    object: Target
    simulation: SimulationSettings
    cluster: Cluster
    splits: Annotated[tuple[str, ...], Setting("Of simulation.cycles.", choices=SPLITS)]
    root: Annotated[str, SCENE_SETS]
    workers: Annotated[int | None, WORKERS]
    executor: Annotated[str, EXECUTOR]
    force: Annotated[bool, Setting("Throw complete sets away and generate them again.")]


@dataclass(frozen=True, kw_only=True)
class ViewSettings(VerbSettings):
    """Which scene is shown, through which sensor."""

    verb: ClassVar[str] = "view"
    object: Target
    simulation: SimulationSettings
    split: Annotated[str, Setting("Whose set.", choices=SPLITS)]
    scene: Annotated[int, Setting("Number in the set; its cycle is simulated when missing.", low=0, high=1_000_000_000)]
    sensor: Annotated[str, Setting("Preset, see conf/data.", choices=PRESETS)]
    sigma_mm: Annotated[float, Setting("gaussian: standard deviation per axis.", low=0, high=100)]
    max_points: Annotated[int, Setting("Most points of the cloud.", low=3, high=10_000_000)]
    root: Annotated[str, SCENE_SETS]
    output: Annotated[str, Setting("Where the pictures go.")]
    scanner: Annotated[
        Sensor | None, Setting("Figures of the preset that is shown, as the object's cell has them; null = its own.")
    ] = None

    @property
    def shown_sensor(self) -> Sensor:
        """The preset with the figures of the object's cell where that has the same one.

        Raises:
            ValueError: when the figures do not fit together.
        """
        if self.scanner is not None and self.scanner.preset == self.sensor:
            return self.scanner
        return Sensor(self.sensor, sigma_mm=self.sigma_mm)


@dataclass(frozen=True, kw_only=True)
class WriteDataSettings(VerbSettings):
    """Which scenes are written, in which layout."""

    verb: ClassVar[str] = "write_data"
    object: Target
    simulation: SimulationSettings
    format: Annotated[str, Setting("Layout.", choices=("ipa", "bop"))]
    split: Annotated[str, Setting("Whose set.", choices=SPLITS)]
    directory: Annotated[str, Setting("IPA: <directory>/ipa/testing/<object>; BOP: <directory>/bop/<object>/test.")]
    scenes: Annotated[int, Setting("At most so many scenes, the first ones.", low=1, high=100_000)]
    root: Annotated[str, SCENE_SETS]
    workers: Annotated[int | None, WORKERS]


@dataclass(frozen=True, kw_only=True)
class CheckDataSettings(VerbSettings):
    """Which dataset is looked at."""

    verb: ClassVar[str] = "check_data"
    directory: Annotated[str, Setting("The dataset's folder, or one that holds several: IPA, Sileane or BOP layout.")]
    scenes: Annotated[int, Setting("So many scenes of each are opened whole, spread evenly.", low=1, high=100_000)]


@dataclass(frozen=True, kw_only=True)
class PartSettings(VerbSettings):
    """A new part."""

    verb: ClassVar[str] = "part"
    name: Annotated[str, Setting("Small letters, digits and underscores, a letter first.")]
    mesh: Annotated[str, Setting("The file: STEP, STL, OBJ, PLY or GLB.")]
    units: Annotated[
        str | None,
        Setting("Of the file's numbers; null = what the file says, else m.", choices=("m", "cm", "mm", "inch")),
    ]
    body: Annotated[
        int | None,
        Setting("Of an assembly, the largest is 1; 0 = all as one part; null = it has one.", low=0, high=10_000),
    ]
    title: Annotated[str, Setting("One line for people; empty: made from the name.")]
    tolerance: Annotated[
        float,
        Setting(
            "How far a turned surface may be from itself beyond its facets' height, a share of D.", above=0, high=0.05
        ),
    ]
    sensor: Annotated[
        str | None,
        Setting("Of the cell: a model, or custom; null = by the bin's size.", choices=(*SENSOR_MODELS, CUSTOM)),
    ]
    bin: Annotated[str | None, Setting("Inner length x width x height in mm; null = a usual one for the part's size.")]
    distance: Annotated[
        float | None,
        Setting("From the camera to the bin, mm; null = so that the bin fills the picture.", low=50, high=100_000),
    ]
    camera: Annotated[
        str | None, Setting("Of a custom sensor: a file with fx.., cam_K, K or ROS's CameraInfo; null = none.")
    ]
    force: Annotated[bool, Setting("Replace an object of the same name.")]
    parts: Annotated[str, Setting("Where the mesh in the part frame and its picture go.")]
    objects: Annotated[
        str | None,
        Setting("Where the object's configuration goes; null = object/ in the folder of CONF=, else in conf/."),
    ]


@dataclass(frozen=True, kw_only=True)
class ScoreSettings(VerbSettings):
    """Which results are scored against which truth."""

    verb: ClassVar[str] = "score"
    gt: Annotated[str, Setting("Sileane: folder of NAME.json with the true poses. BOP: folder of a split.")]
    results: Annotated[str, Setting("Sileane: folder of NAME.json with results. BOP: METHOD_DATASET-SPLIT.csv.")]
    poseutils: Annotated[str | None, Setting("Sileane: poseutils.json of the part.")]
    occlusion: Annotated[
        float, Setting("Sileane: true poses occluded up to this share must be found; above 1 all.", low=0, high=2)
    ]
    threshold_scale: Annotated[
        float, Setting("Sileane: share of distance_threshold up to which a pose is right.", above=0, high=100)
    ]
    frame: Annotated[
        Literal["toolbox", "object"], Setting("Sileane: toolbox = as published; object = Rref2i and tref2i applied.")
    ]
    curve: Annotated[bool, Setting("Sileane: also AP at 21 thresholds from 0 to the one above (Fig. 8).")]
    result_limit: Annotated[
        int | None, Setting("Only this many best results of a scene or image.", low=1, high=1_000_000)
    ]
    models: Annotated[str | None, Setting("BOP: folder with models_info.json and obj_NNNNNN.ply.")]
    targets: Annotated[str | None, Setting("BOP: file of targets (scene_id, im_id); null = every image.")]
    suffix: Annotated[str | None, Setting("BOP: SUFFIX of scene_gt_SUFFIX.json; null = none.")]
