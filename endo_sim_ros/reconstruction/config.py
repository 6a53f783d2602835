"""Options of the reconstruction stage; `presets` names sets of them."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from endo_sim_ros.core.config import Range, StageConfig
from endo_sim_ros.reconstruction.stage_configs import (
    CapacityConfig,
    CoverageConfig,
    DynamicMaskConfig,
    ExtrapolationConfig,
    GlossConfig,
    InitialModelConfig,
    InterpolationConfig,
    LensConfig,
    MatchingConfig,
    MotionSearchConfig,
    MultiViewConfig,
    NetworkDepthConfig,
    PhotometryConfig,
    PlaneSweepConfig,
    PosesConfig,
    StereoConfig,
    TiltedConfig,
    TrainingSizeConfig,
    UsableViewsConfig,
)


@dataclass(frozen=True)
class LearningRatesConfig(StageConfig):
    """Learning rates of Adam: those of 3DGS, of sizes and colours raised for a tenth of its iterations."""

    means: Annotated[float, Range(0, 1, "scene depths")] = 1.6e-4
    """Of the positions, at first."""
    means_decay: Annotated[float, Range(1e-6, 1)] = 0.01
    """Factor on that of the positions at the last iteration; it falls exponentially."""
    quats: Annotated[float, Range(0, 1)] = 1e-3
    """Of the rotations."""
    log_scales: Annotated[float, Range(0, 1)] = 2e-2
    """Of the logarithm of the sizes."""
    logit_opacities: Annotated[float, Range(0, 1)] = 5e-2
    """Of the opacities, before the sigmoid."""
    sh_base: Annotated[float, Range(0, 1)] = 1e-2
    """Of the colours."""
    sh_rest: Annotated[float, Range(0, 1)] = 1.25e-4
    """Of the higher spherical harmonics."""
    gloss: Annotated[float, Range(0, 1)] = 2e-2
    """Of the normals and of how strongly tissue reflects, at first."""
    gloss_decay: Annotated[float, Range(1e-6, 1)] = 0.03
    """Factor on that of the reflections at the last iteration, as at one rate they jump about their optimum to the end."""
    gloss_decay_from: Annotated[float, Range(0, 0.99)] = 0.4
    """Share of the iterations after which that falls, exponentially: at once, and few iterations would not find the films that glint."""
    light: Annotated[float, Range(0, 1)] = 2e-3
    """Of the four numbers of the light and of the shoulder of the camera's curve; `learning_rate` is no factor on it."""
    exposures: Annotated[float, Range(0, 1)] = 1e-3
    """Of the logarithm of the exposures; `learning_rate` is no factor on it."""


@dataclass(frozen=True)
class McmcConfig(StageConfig):
    """Densification as a Markov chain (3DGS-MCMC)."""

    growth: Annotated[float, Range(0, 1)] = 0.05
    """Share of new Gaussians added at each refinement until max_gaussians is reached."""
    dead_opacity: Annotated[float, Range(0, 1)] = 0.005
    """Opacity up to which a Gaussian is dead and moves to a live one; that of 3DGS."""
    most_copies: Annotated[int, Range(1, 1000)] = 50
    """Copies of one Gaussian at a refinement, above which more share its opacity as so many would; sums of more terms lose digits."""
    noise: Annotated[float, Range(0, 1e9)] = 5e5
    """Size of random steps of faint Gaussians, in units of the learning rate of the means, for a scene of depth 1; that of 3DGS-MCMC."""
    noise_every: Annotated[int, Range(1, 1000)] = 4
    """Iterations between such steps, which are larger by its square root: seldom is cheaper, and diffuses as far."""


@dataclass(frozen=True)
class GradientConfig(StageConfig):
    """Densification by image gradients (3DGS, AbsGS)."""

    dead_opacity: Annotated[float, Range(0, 1)] = 0.005
    """Opacity up to which a Gaussian is removed; that of 3DGS."""
    threshold: Annotated[float, Range(0, 1, "per half image")] = 8e-4
    """Mean absolute gradient by its position in the image of a Gaussian that becomes two; that of AbsGS."""
    large: Annotated[float, Range(0, 1, "scene depths")] = 0.01
    """Standard deviation above which a Gaussian is split, up to which it is doubled; that of 3DGS."""
    shrink: Annotated[float, Range(1, 10)] = 1.6
    """Factor by which the halves of a split Gaussian are smaller; that of 3DGS."""
    absolute: bool = True
    """Gradients of pixels count without their signs, as AbsGS has it, so that they do not cancel as those of 3DGS do."""
    reset_every: Annotated[int, Range(0, 1_000_000)] = 0
    """Iterations after which opacities fall to reset_to, so that what is not needed can fade; 3DGS takes 3000, 0 = never. In the last
    tenth of the training they do not, as they take long to rise again."""
    reset_first: Annotated[int, Range(0, 1_000_000)] = 0
    """Iteration in which they fall first; 0 = reset_every."""
    reset_to: Annotated[float, Range(0.001, 1)] = 0.01
    """Highest opacity after that; that of 3DGS."""
    oversize: Annotated[float, Range(0, 100, "scene depths")] = 0.0
    """Standard deviation above which a Gaussian is removed once opacities have fallen; 3DGS takes 0.1, 0 = none is."""


@dataclass(frozen=True)
class ProximityConfig(GradientConfig):
    """Densification by image gradients and by how lonely Gaussians are (FSGS)."""

    neighbours: Annotated[int, Range(1, 100)] = 3
    """Number of nearest neighbours that tell how lonely a Gaussian is, and halfway to which new ones come; that of FSGS."""
    far: Annotated[float, Range(1, 100)] = 2.0
    """Mean distance from them above which a Gaussian is lonely, in medians over all, so that it fits scenes of any size."""
    unpool_until: Annotated[int, Range(0, 1_000_000)] = 0
    """Iteration from which on no more come between those that are lonely; FSGS takes 2000, 0 = as long as any are added."""


@dataclass(frozen=True)
class ReconstructionConfig(StageConfig):
    """From sparse posed views to a Gaussian model."""

    keyframes: Annotated[int, Range(0, 1000)] = 0
    """Number of views to train on, spread over the camera path; 0 = as many as it takes to cover that (coverage.*)."""
    image_width: Annotated[int, Range(16, 8192, "pixels")] = 640
    """Views wider than this are shrunk to it before training."""
    prepared_width: Annotated[int, Range(16, 8192, "pixels")] = 960
    """Views wider than this, and than image_width, are shrunk to the wider of the two before anything else. More takes longer, and its
    depth is no better: edges of tissue are no sharper."""
    iterations: Annotated[int, Range(0, 1_000_000)] = 0
    """Optimisation steps; 0 = as many as the views need, by `training.*`."""
    max_gaussians: Annotated[int, Range(0, 10_000_000)] = 0
    """Largest number of Gaussians; 0 = as many as the views can tell of, by `training.*`."""
    sh_degree: Annotated[int, Range(0, 3)] = 0
    """Degree of the spherical harmonics; 0 is the paper's frequency regularisation."""
    sh_every: Annotated[int, Range(0, 100_000)] = 0
    """Iterations after which that degree rises by one, from 0 on: 3DGS takes 1000, 0 = it is there from the start."""
    initialization: Literal["depth", "points"] = "depth"
    """What training starts from: the depth prior of every view, checked between views, or triangulated points alone."""
    depth: Literal["auto", "topic", "stereo", "network", "points", "none", "network_first"] = "auto"
    """Depth prior: the depth topic, matching with the right image, a network that sees depth in one image, interpolation
    between triangulated points, none, or the first of these that exists; network_first is auto, but with the network first, as the
    paper has it, and a warning where there is none."""
    depth_model: str = ""
    """network: folder of a checkpoint of Depth-Anything-V2 or another depth network (transformers), or ONNX file; nothing is ever
    downloaded. Empty: the Depth-Anything-V2 that Hugging Face's cache holds."""
    watch_motion: bool = True
    """Look for tissue that moves periodically by itself, say so, and reconstruct it in its mean position."""
    plane_sweep: bool = True
    """Believe depth that is interpolated close to scene points alone; elsewhere match the views plane by plane. So are pairs of images
    matched that show too few features for stereo matching."""
    multi_view_refinement: bool = True
    """Correct the depth of stereo, network or points by scene points and by how the right image and the other views show the
    same tissue."""
    extrapolation: Annotated[float, Range(0, 1)] = 0.3
    """How far tissue goes on beyond what the training views see, in widths of the image, so that other views do
    not look into the void; holes of the depth prior are filled likewise. 0 = neither."""
    depth_tolerance: Annotated[float, Range(0.001, 1)] = 0.05
    """Relative depth difference at which two views contradict each other."""
    dynamic_mask: bool = True
    """Leave out of a view what contradicts two others: an instrument that is there in it alone, for instance."""
    dropout: Annotated[float, Range(0, 0.9)] = 0.1
    """Share of the Gaussians that an iteration leaves out at random, the others being denser for it, as in DropGaussian (Park et al. 2025),
    so that they do not memorise few views together. It rises with the iterations from 0 on, and is 0 again after refine_until."""
    hidden_below: Annotated[float, Range(0, 1)] = 0.5
    """Gaussians of whose opacity less than this part arrives in training views, as others hide it, take on the colour that is seen in front
    of them as tissue is strained: those that they learn are stains, which show where tissue is pulled. With sh_degree 0 only.
    0 = they keep it."""
    lambda_ssim: Annotated[float, Range(0, 1)] = 0.2
    """Share of 1 − SSIM in the photometric loss; the rest is L1."""
    lambda_depth: Annotated[float, Range(0, 1000)] = 1.0
    """Weight of the depth loss, in units of the scene's median depth (paper eq. 4)."""
    unmeasured_depth: Annotated[float, Range(0, 1)] = 0.1
    """Factor on ``lambda_depth`` where depth is told from the images, by stereo matching, scene points or a network: the whole weight
    holds Gaussians where it is wrong away from where the views have the tissue. Depth of a topic has the whole weight."""
    lambda_opaque: Annotated[float, Range(0, 1000)] = 0.01
    """Weight, within the depth loss, of transparency, depth being the mean of what is seen; 0 = that of the paper, Σ w z, in which
    what is transparent counts as near, so that tissue comes to lie a little too deep."""
    lambda_dist: Annotated[float, Range(0, 1000)] = 0.0
    """Weight of the distortion loss, in units of the scene's median depth (paper eq. 5)."""
    lambda_tv: Annotated[float, Range(0, 1000)] = 0.0
    """Weight of the total variation of the rendered depth, in units of the scene's median depth (paper eq. 6, third term)."""
    lambda_pearson: Annotated[float, Range(0, 1000)] = 0.0
    """Weight of 1 − correlation of depth and prior, in training views and in virtual ones to which the prior is carried (FSGS)."""
    lambda_opacity: Annotated[float, Range(0, 1000)] = 0.01
    """Weight of the mean opacity of the Gaussians within what the views show, as in 3DGS-MCMC: what explains nothing fades."""
    lambda_scale: Annotated[float, Range(0, 1000)] = 0.01
    """Weight of their mean standard deviation, in units of the scene's median depth, as in 3DGS-MCMC."""
    virtual_every: Annotated[int, Range(0, 1000)] = 0
    """A virtual camera regularises every n-th iteration (paper eq. 7, 8), by what of the distortion, total variation and
    correlation has a weight; 0 = never."""
    virtual_from: Annotated[int, Range(0, 1_000_000)] = 0
    """Iterations before the first virtual camera."""
    virtual_weight: Annotated[float, Range(0, 1000)] = 1.0
    """Factor on those weights in virtual cameras."""
    exposure: bool = True
    """Each view has an exposure of its own, from which that of unseen views is predicted as a camera's automatic one would be."""
    light: bool = True
    """The light travels with the camera: brightness falls off with distance and angle. Training starts without where views contradict."""
    reflections: bool = True
    """Tissue reflects the light: highlights are a layer of their own, and tissue that turns away is darker. With `sh_degree` 0 alone."""
    light_anchor: Annotated[float, Range(0, 1000)] = 1e-3
    """Weight of squared changes of the light in training: where views hardly differ in distance, colours could explain all of it."""
    densification: Literal["mcmc", "gradient", "proximity"] = "mcmc"
    """How Gaussians are added: a Markov chain up to max_gaussians, where image gradients are large (3DGS), or there and
    between those that lie alone (FSGS)."""
    refine_every: Annotated[int, Range(1, 100_000)] = 100
    """Iterations between relocations of dead Gaussians and growth."""
    refine_from: Annotated[int, Range(0, 1_000_000)] = 0
    """Iterations before the first one."""
    refine_until: Annotated[float, Range(0, 1)] = 0.8
    """Share of the iterations after which the number of Gaussians stays, so that the last ones settle."""
    schedule: Annotated[int, Range(0, 1_000_000)] = 0
    """Iterations that refine_until, rates.*_decay* and watch.learn_from are meant for, however many are trained; 0 = those trained."""
    unit: Literal["depth", "cameras"] = "depth"
    """What a scene depth is for rates.means and for the sizes that densification compares with: the median depth of the scene, or
    3DGS's extent of the cameras, 1.1 times the largest distance from their mean (the median depth where they are in one place)."""
    largest: Annotated[float, Range(1e-4, 100, "scene depths")] = 0.06
    """Largest standard deviation of a Gaussian. Nothing else limits those where every view is masked, and a large one smears the
    deformed scene."""
    learning_rate: Annotated[float, Range(1e-3, 100)] = 1.5
    """Factor on the learning rates of the Gaussians."""
    smallest_width: Annotated[int, Range(1, 8192, "pixels")] = 64
    """Out of memory, training goes on with images of half the width, but none below this."""
    seed: Annotated[int, Range(0, 2**31 - 1)] = 0
    """Seed of all random draws; the same seed gives the same model on a CPU, bit for bit."""
    device: str = "auto"
    """Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N."""

    # Of the stages that prepare the scene, in their order. Where a switch above has the name of the stage, its options have another.

    coverage: CoverageConfig = CoverageConfig()
    views: UsableViewsConfig = UsableViewsConfig()
    matching: MatchingConfig = MatchingConfig()
    lens: LensConfig = LensConfig()
    poses: PosesConfig = PosesConfig()
    watch: MotionSearchConfig = MotionSearchConfig()
    stereo: StereoConfig = StereoConfig()
    network: NetworkDepthConfig = NetworkDepthConfig()
    interpolation: InterpolationConfig = InterpolationConfig()
    sweep: PlaneSweepConfig = PlaneSweepConfig()
    multi_view: MultiViewConfig = MultiViewConfig()
    motion: DynamicMaskConfig = DynamicMaskConfig()
    initial: InitialModelConfig = InitialModelConfig()
    training: TrainingSizeConfig = TrainingSizeConfig()
    capacity: CapacityConfig = CapacityConfig()
    photometry: PhotometryConfig = PhotometryConfig()
    extrapolated: ExtrapolationConfig = ExtrapolationConfig()
    gloss: GlossConfig = GlossConfig()
    # Of the training.
    rates: LearningRatesConfig = LearningRatesConfig()
    tilted: TiltedConfig = TiltedConfig()
    mcmc: McmcConfig = McmcConfig()
    gradient: GradientConfig = GradientConfig()
    proximity: ProximityConfig = ProximityConfig()

    needs: ClassVar[dict[str, tuple[str, ...]]] = {
        "coverage": ("keyframes", "0"),
        "depth_model": ("depth", "auto", "network", "network_first"),
        "network": ("depth", "auto", "network", "network_first"),
        "unmeasured_depth": ("lambda_depth", "more than 0"),
        "light_anchor": ("light", "true"),
        "sh_every": ("sh_degree", "more than 0"),
        "virtual_from": ("virtual_every", "more than 0"),
        "virtual_weight": ("virtual_every", "more than 0"),
        **{f"lens.{name}": ("lens.correct", "true") for name in ("left", "exact", "most_tracks")},
        **{
            f"poses.{name}": ("poses.correct", "true") for name in ("exact", "foreseen", "left", "turn_error", "place_error", "most_tracks")
        },
        "sweep": ("plane_sweep", "true"),
        "multi_view": ("multi_view_refinement", "true"),
        "multi_view.reflection": (),  # tells films, too, where highlights are
        "motion": ("dynamic_mask", "true"),
        "extrapolated": ("extrapolation", "more than 0"),
        "extrapolated.min_coverage": (),  # nor do planes start from less
        "gloss": ("reflections", "true"),
        "watch": ("watch_motion", "true"),
        **{f"training.{name}": ("iterations", "0") for name in ("iterations_per_view", "min_iterations", "max_iterations")},
        **{f"training.{name}": ("max_gaussians", "0") for name in ("pixels_per_gaussian", "min_gaussians", "max_gaussians")},
        "capacity.fewer": ("max_gaussians", "0"),
        "capacity.fading": ("max_gaussians", "0"),
        "tilted.weight": ("tilted.every", "more than 0"),
        "tilted.angle": ("tilted.every", "more than 0"),
        "mcmc": ("densification", "mcmc"),
        "gradient": ("densification", "gradient"),
        "proximity": ("densification", "proximity"),
    }
    renamed: ClassVar[dict[str, str]] = {
        "agreement": "multi_view_refinement",
        "surroundings": "extrapolation",
        "still": "dynamic_mask",
        "growth": "mcmc.growth",
        "right_views": "gone, as it cost quality on average",
        "confined": "gone, as it brought less than 0.2 dB",
        "lambda_flat": "gone, as pictures are as good without",
    }

    @property
    def widest(self) -> int:
        """Width that views are prepared in at most, pixels."""
        return max(self.prepared_width, self.image_width)
