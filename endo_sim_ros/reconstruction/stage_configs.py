"""Options of the stages that prepare a scene, in the order of the pipeline; `ReconstructionConfig` nests them."""

from dataclasses import dataclass
from typing import Annotated

from endo_sim_ros.core.config import Range, StageConfig


@dataclass(frozen=True)
class CoverageConfig(StageConfig):
    """How many views of a recording are trained on: so many that each of the others has one nearby."""

    new_share: Annotated[float, Range(0.001, 1, "widths of the picture")] = 0.015
    """How much of a view may be new to the nearest keyframe: by how much of its picture's width the camera moved or what it looks at.
    This is 2 mm at the usual distance. It gives a camera that sways 26 views, and one that flies over 30 cm 80 to 160."""
    min_keyframes: Annotated[int, Range(1, 1000)] = 8
    """Fewest keyframes: those of a camera that hardly moves still tell depth, exposure and what moves."""
    max_keyframes: Annotated[int, Range(1, 1000)] = 200
    """Most keyframes: the preparation takes time and memory for each; beyond it they only lie farther apart."""


@dataclass(frozen=True)
class UsableViewsConfig(StageConfig):
    """Which views show enough tissue to be trained on."""

    white: Annotated[int, Range(1, 255, "grey levels")] = 250
    """A pixel of which all channels are at least this is overexposed; encoders leave white a few levels short of 255. Where
    something reflects, a channel that is at least this may be any brighter in training."""
    overexposed_share: Annotated[float, Range(0, 1)] = 0.5
    """Share of a view's tissue that is overexposed, above which the view is left out."""
    black: Annotated[int, Range(0, 254, "grey levels")] = 8
    """A pixel of which no channel is above this is black: the noise of a dark sensor stays below."""
    black_share: Annotated[float, Range(0, 1)] = 0.95
    """Share of a view's tissue that is black, above which the view is left out; much of a good one may lie in the dark."""
    even: Annotated[int, Range(0, 255, "grey levels")] = 3
    """A view of which all channels are off their medians by less, but for a twentieth of its tissue, is left out: recorders fill
    pictures with one colour where a cable is loose, and codecs change it by a level or two. 0 leaves out none."""


@dataclass(frozen=True)
class MatchingConfig(StageConfig):
    """Features that views share, and scene points triangulated from them."""

    max_features: Annotated[int, Range(50, 100_000)] = 4000
    """SIFT features of an image, the strongest first; the time to match two images grows with the square."""
    ratio: Annotated[float, Range(0.3, 1)] = 0.8
    """Largest ratio of the distances of a feature's best and second-best match. Lowe 2004: 0.8 drops nine of ten wrong matches and one
    of twenty right ones."""
    neighbours: Annotated[int, Range(1, 100)] = 3
    """Views that each view is matched with: the nearest in space."""
    reprojection_error: Annotated[float, Range(0.1, 100, "pixels")] = 2.0
    """Farthest that a scene point may lie from its features: poses and calibration are a pixel or two off."""
    min_parallax: Annotated[float, Range(0.01, 45, "degrees")] = 1.0
    """Smallest angle between the rays to a scene point; below it a pixel is several per cent of its depth."""
    outlier_depth: Annotated[float, Range(0.001, 10)] = 0.1
    """Relative difference from the depth of the eight points around, in an image, from which on a scene point is a wrong match or
    hidden."""
    min_points: Annotated[int, Range(8, 10_000)] = 30
    """Matches or scene points from which on they tell anything: whether poses are right, where the right image is off, depth between
    them. Fewer may agree by accident."""


@dataclass(frozen=True)
class LensConfig(StageConfig):
    """When the lens is not as recorded."""

    correct: bool = True
    """Find focal lengths, principal point and distortion by features that several views share, where those recorded are wrong. Pictures
    are straightened for training, and scene points triangulated anew."""
    left: Annotated[float, Range(0, 1)] = 0.6
    """Part of the distance of a left-out view's features from where the other views have them that another lens may leave, or the lens is
    as recorded; and another principal point, or pixels that are not square, of what is left without them. Of right lenses it leaves 0.98
    to 1, of those a fifth too long 0.04 to 0.7, by how the camera moved."""
    exact: Annotated[float, Range(0, 1, "widths of the image")] = 0.003
    """What it may leave at most: features of right poses lie 0.0003 to 0.002 beside. Wrong poses, or moving tissue, leave more."""
    most_tracks: Annotated[int, Range(10, 100_000)] = 100
    """Features of a view at most by which it is found, those that most views see first."""


@dataclass(frozen=True)
class PosesConfig(StageConfig):
    """Which poses contradict what the views share, and how those that are off by a little are corrected."""

    min_error: Annotated[float, Range(0, 1, "widths of the image")] = 0.007
    """Median distance of matches from where the poses expect them, up to which poses are right: calibration and structure from motion
    leave as much."""
    max_error: Annotated[float, Range(0, 1, "widths of the image")] = 0.02
    """Median distance from which on they are wrong whatever the others are; tissue that breathes moves by less."""
    outlier_factor: Annotated[float, Range(1, 1000)] = 5.0
    """In between, how many times as far off as the best fifth of the groups of views a wrong one is."""
    correct: bool = True
    """Correct poses that are off by a little, as those of a robot's joints, by features that several views share. Then scene points are
    triangulated anew."""
    exact: Annotated[float, Range(0, 1, "widths of the image")] = 0.0015
    """Median distance of features from one point each, up to which poses are right: structure from motion and calibration leave 0.0003 to
    0.001."""
    foreseen: Annotated[float, Range(0, 1)] = 0.9
    """Part of the distance of a left-out view's features from where the other views have them that corrected poses may leave, or poses
    stay: what moves is the tissue then. All of it may stay where features become exact. Poses go off gradually if interpolating between
    the other views leaves no more than this part, too."""
    left: Annotated[float, Range(0, 1)] = 0.5
    """Part of the distance of all features from one point each that corrected poses may leave, or poses stay. Poses that are off leave
    0.04 to 0.45, a tool that moves in half of the picture 0.8 to 0.9."""
    turn_error: Annotated[float, Range(1e-3, 90, "degrees")] = 1.0
    """Standard deviation of turns of poses that are off. It holds what features do not tell."""
    place_error: Annotated[float, Range(1e-5, 10)] = 0.02
    """The same of their places, as a part of the distance of the tissue."""
    mount_error: Annotated[float, Range(1e-3, 100)] = 5.0
    """Standard deviation of what all poses are off by alike, in those of single ones: the lens sits elsewhere on its arm than a hand-eye
    calibration says."""
    mount_views: Annotated[int, Range(3, 10_000)] = 5
    """Views from which on that is told, and another principal point, or pixels that are not square: of three or four a breath looks like
    these."""
    most_tracks: Annotated[int, Range(10, 100_000)] = 200
    """Features of a view at most by which poses are corrected, those that most views see first. Twenty views take half a second so."""


@dataclass(frozen=True)
class StereoConfig(StageConfig):
    """Depth by matching the right image of a stereo pair."""

    nearest: Annotated[float, Range(0.001, 1, "m")] = 0.02
    """Distance of the nearest tissue that is searched for, unless features of the pairs lie nearer; closer no laparoscope works. The
    search takes time in proportion to its inverse."""
    min_disparity: Annotated[float, Range(0.1, 100, "pixels")] = 2.0
    """Smallest disparity that gives depth: half a pixel is a quarter of the depth there."""
    max_disparity: Annotated[float, Range(0.01, 1, "widths of the image")] = 0.1
    """Largest disparity of what a tool in the left image hides in the right one; masks are widened by it."""
    disparity_error: Annotated[float, Range(0.01, 10, "pixels")] = 0.5
    """Standard deviation of a disparity: semi-global matching prefers whole pixels."""
    min_area: Annotated[float, Range(0, 1)] = 0.003
    """Share of the image below which a patch of disparity that is like none around it is a wrong match."""
    max_row_offset: Annotated[float, Range(0, 0.5, "heights of the image")] = 0.01
    """Largest distance between the rows of a match after rectification; matches that are farther apart are wrong."""
    own_offset_points: Annotated[int, Range(1, 100_000)] = 100
    """Scene points from which on a view has an offset of its own: poses and baselines of views err differently, but their points err
    alike."""
    max_offset: Annotated[float, Range(0, 10)] = 0.3
    """Largest offset, in median disparities: a larger one is no principal point, but poses of another scale."""
    same_surface: Annotated[float, Range(0.1, 100, "planes")] = 4.0
    """Of smooth pairs, which are matched plane by plane, what `sweep.same_surface` is of views: their planes are up to four times finer.
    With less, depth has more holes, and what is guessed there is worse."""


@dataclass(frozen=True)
class NetworkDepthConfig(StageConfig):
    """Depth by a network, which knows it up to a scale and a shift of its inverse."""

    max_error: Annotated[float, Range(0.001, 1)] = 0.1
    """Median relative error of inverse depth above which the fit has failed."""
    max_unexplained: Annotated[float, Range(0.01, 1)] = 0.7
    """Share of the spread of the known inverse depths that the fit may leave; a network that leaves more tells no more than one depth
    for all."""


@dataclass(frozen=True)
class InterpolationConfig(StageConfig):
    """How depth and colour are continued from pixels and scene points to where there are none."""

    cell: Annotated[float, Range(0.001, 0.2, "widths of the image")] = 1 / 80
    """Side of the cells that values are told for, and the spacing of extrapolated Gaussians."""
    pixel_error: Annotated[float, Range(0, 10, "widths of the image")] = 1 / 128
    """Error of a known pixel, as the distance in the image over which inverse depth usually changes by as much."""
    point_error: Annotated[float, Range(0, 10, "widths of the image")] = 1 / 8
    """The same for a scene point. A larger value gives a smoother surface between the points."""
    neighbours: Annotated[int, Range(1, 1000)] = 40
    """Pixels and points, the nearest, that tell a value; time grows with the third power."""
    margin: Annotated[float, Range(0, 10)] = 0.2
    """Share by which inverse depth may pass the limits of its known range; kriging overshoots where slopes meet a gap."""


@dataclass(frozen=True)
class PlaneSweepConfig(StageConfig):
    """Depth away from scene points, by matching views on plane after plane."""

    width: Annotated[int, Range(32, 4096, "pixels")] = 320
    """Width at which views are matched: finer, tissue has little to match, and the refinement between views corrects fractions of it."""
    neighbours: Annotated[int, Range(2, 100)] = 6
    """Views that each view is matched with: the nearest in space."""
    point_reach: Annotated[float, Range(0, 1, "widths of the image")] = 0.04
    """Distance from a scene point up to which depth is interpolated. Farther off the surface may have an edge that no point tells of."""
    window: Annotated[int, Range(3, 101, "pixels")] = 9
    """Side of the square that is compared."""
    shading: Annotated[float, Range(0.01, 10, "widths of the image")] = 0.2
    """Standard deviation of the blur that is taken from pictures before they are matched: the light goes with the camera, so that what it
    does to smooth tissue stands still in the picture, as if it were infinitely far."""
    levels: Annotated[int, Range(1, 5)] = 3
    """Widths at which views of too few scene points are matched, each half of the one before, narrower views as they are; where one is not
    sure the next one tells, in which half as much counts as noise."""
    most_shift: Annotated[float, Range(0.01, 1, "widths of the image")] = 0.5
    """Without scene points, how far pictures of two views move at most by how near the tissue is; nearer tissue is not looked for."""
    noise: Annotated[float, Range(0.1, 50, "grey levels")] = 3.0
    """Standard deviation of a picture's noise: what differs by less is alike on any plane."""
    margin: Annotated[float, Range(0, 10)] = 0.35
    """How far the planes go on nearer and farther than the scene points, in median inverse depths; what seems farther than the median
    depth divided by it, and than the points, is believed to be dirt on the lens. Without points the median is of what all views found."""
    nearest: Annotated[float, Range(1, 100)] = 3.0
    """Planes go on at least to so many median inverse depths, 3 being a third of the median depth: what stands in front of the tissue may
    have no scene point."""
    min_planes: Annotated[int, Range(4, 1000)] = 32
    """Fewest planes; else there is one for each pixel by which the picture of the median neighbour moves; without scene points, of the
    farthest."""
    max_planes: Annotated[int, Range(4, 1000)] = 160
    """Most planes: time and memory grow with their number."""
    small_penalty: Annotated[float, Range(0, 10)] = 0.05
    """Cost of a step by one plane between neighbouring pixels; that of what is not alike at all is 1."""
    large_penalty: Annotated[float, Range(0, 10)] = 0.4
    """Cost of a larger step: an edge."""
    max_cost: Annotated[float, Range(0, 1)] = 0.3
    """1 − correlation above which views do not show the same: interpolated depth is right more often than a match that is less sure."""
    min_views: Annotated[int, Range(1, 100)] = 2
    """Other views that must have found the same surface: one may agree by accident, and two views alone tell less than their points."""
    most_aside: Annotated[float, Range(1, 180, "degrees")] = 45.0
    """Angle between two views of a place up to which they show it alike: beyond it windows are foreshortened by 30 % and more, so
    that the one cannot confirm the other."""
    same_surface: Annotated[float, Range(0.1, 100, "planes")] = 1.5
    """Largest distance between what two views found that still is one surface: either is off by half a plane, and smoothness by more."""
    min_area: Annotated[float, Range(0, 1)] = 0.003
    """Share of the image below which a patch of depth that is like none around it is a wrong match."""
    smoothing: Annotated[float, Range(1, 640, "pixels at width 640")] = 12.0
    """Standard deviation of the window over which the steps between planes are smoothed."""
    edge: Annotated[float, Range(0.001, 1)] = 0.1
    """Relative step of the depth that is an edge, and stays."""


@dataclass(frozen=True)
class MultiViewConfig(StageConfig):
    """Refinement of the depth prior by other images of the same tissue."""

    neighbours: Annotated[int, Range(1, 100)] = 4
    """Views that each view is compared with: the nearest in space."""
    width_factor: Annotated[int, Range(1, 16)] = 2
    """Width at which depth is corrected, in widths trained on, if images are as wide. The finer the pixels, the more precise is flow."""
    prior_error: Annotated[float, Range(0.001, 1)] = 0.05
    """Relative error of the depth of a network, and of any other of which none is known."""
    points_error: Annotated[float, Range(0.001, 1)] = 0.015
    """Relative error of depth interpolated between scene points."""
    refined_disparity_error: Annotated[float, Range(0.01, 10, "pixels")] = 0.15
    """Error of a disparity that flow between the eyes has corrected; before, it is ``stereo.disparity_error``."""
    flow_error: Annotated[float, Range(0.1, 100)] = 3.0
    """Error of the flow along the line in which depth moves a pixel, in standard deviations of the flow across it, which are measured
    for each pair of images. More than 1, as pixels side by side err alike."""
    max_round_trip: Annotated[float, Range(0.01, 100, "pixels")] = 0.4
    """By how much flow there and flow back may miss each other. They do where one image shows what the other hides."""
    max_flow: Annotated[float, Range(1, 640, "pixels at width 640")] = 40.0
    """Longest displacement between prediction and image that is believed."""
    max_beside: Annotated[float, Range(0.01, 640, "pixels at width 640")] = 2.0
    """Largest distance of a match from the line along which depth moves its pixel; a larger one is no error of depth."""
    max_step: Annotated[float, Range(0.01, 640, "pixels at width 640")] = 1.0
    """Largest correction of a disparity by flow between the eyes: matching is off by less, or wholly wrong."""
    reflection: Annotated[int, Range(1, 255, "grey levels")] = 60
    """By how much all channels of a reflection of the light are above what is around it; white is one, too. Between views, reflections
    tell nothing; films face the lens there at first."""
    point_window: Annotated[float, Range(1, 640, "pixels at width 640")] = 11.0
    """Side of the square that a scene point speaks for."""
    doubt: Annotated[float, Range(0.1, 1000)] = 3.0
    """How many errors of the prior a scene point may be off before it counts half: some are wrong matches."""
    max_correction: Annotated[float, Range(0.001, 1)] = 0.25
    """Largest relative correction of inverse depth; what is farther off is another surface."""
    contrast_window: Annotated[float, Range(1, 640, "pixels at width 640")] = 8.0
    """Standard deviation of the window over which brightness and contrast are made alike: light and exposure differ between views."""
    continuation: Annotated[float, Range(1, 640, "pixels at width 640")] = 12.0
    """Standard deviation of the surroundings over which corrections are continued to pixels without."""
    smoothing: Annotated[float, Range(1, 640, "pixels at width 640")] = 10.0
    """Standard deviation of the window over which ripples of the corrected depth are smoothed."""
    edge: Annotated[float, Range(0.001, 1)] = 0.02
    """Relative step of the depth that is an edge, and stays, in the end."""
    eyes_edge: Annotated[float, Range(0.001, 1)] = 0.03
    """The same after the flow between the eyes; of what is known better, smaller steps are edges."""
    matched_window: Annotated[float, Range(1, 640, "pixels at width 640")] = 24.0
    """Standard deviation of the window over which the steps of semi-global matching are smoothed: they are wider than ripples."""
    matched_edge: Annotated[float, Range(0.001, 1)] = 0.1
    """Relative step of the depth that is an edge as matched."""


@dataclass(frozen=True)
class DynamicMaskConfig(StageConfig):
    """What moved between the views."""

    width: Annotated[int, Range(32, 4096, "pixels")] = 320
    """Views are compared at this width: finer, edges of the depth and poses a pixel off would look as if something moved."""
    chroma: Annotated[float, Range(0.01, 10)] = 0.5
    """Difference of log ratios of colours at which two views show something else on the same surface: tissue and a tool. Light and
    exposure hardly change these ratios."""
    min_width: Annotated[float, Range(0, 1, "widths of the image")] = 0.02
    """Narrower pieces are glints and edges of the depth; wider ones are masked with as much of a margin."""
    max_area: Annotated[float, Range(0, 1)] = 0.4
    """Share of the image above which the depth or pose of the view is wrong, and nothing is masked."""


@dataclass(frozen=True)
class InitialModelConfig(StageConfig):
    """The Gaussians that training starts from."""

    opacity: Annotated[float, Range(0.005, 0.995)] = 0.5
    """Opacity of the Gaussians; 3DGS starts with 0.1, but of these most lie on the surface."""
    seen_share: Annotated[float, Range(0.01, 1)] = 0.8
    """Share of ``max_gaussians`` that stand for what the training views see; the others are left to extrapolation."""
    guessed_shift: Annotated[float, Range(0.001, 10, "widths of the image")] = 0.1
    """By how much the picture moves between two views, in the median, where nothing tells depth: training then starts from a plane at
    the depth that follows. Of four recordings and patients it is 0.06 to 0.4."""
    max_slope: Annotated[float, Range(0, 100)] = 2.0
    """Slope of a surface across the line of sight in holes of the depth prior; a point that it would have to rise or fall more for is no
    tissue."""


@dataclass(frozen=True)
class TrainingSizeConfig(StageConfig):
    """How long to train, and with how many Gaussians: of few views, more of either only memorise."""

    iterations_per_view: Annotated[int, Range(1, 100_000)] = 500
    """Optimisation steps for each view: of 20 views a third as many cost up to 2 dB, of 2 to 5 views more brought none."""
    min_iterations: Annotated[int, Range(1, 1_000_000)] = 3000
    """Fewest optimisation steps: as many take the colours to settle."""
    max_iterations: Annotated[int, Range(1, 1_000_000)] = 30_000
    """Most optimisation steps, those of 3DGS."""
    pixels_per_gaussian: Annotated[float, Range(1, 10_000, "pixels")] = 40.0
    """Pixels of all views for each Gaussian: of 20 views, 2.5 times as many cost up to 1.6 dB; of 2 to 9 views, fewer cost SSIM."""
    min_gaussians: Annotated[int, Range(1, 10_000_000)] = 60_000
    """Fewest Gaussians that the limit allows: what two views show, and what is beyond them."""
    least_pixels: Annotated[float, Range(0.1, 10_000, "pixels")] = 2.0
    """Fewest pixels of all views for each Gaussian, of small pictures: with more Gaussians than pixels noise is memorised."""
    max_gaussians: Annotated[int, Range(1, 10_000_000)] = 1_000_000
    """Most Gaussians that the limit allows: more are not drawn in real time."""


@dataclass(frozen=True)
class CapacityConfig(StageConfig):
    """The trial of fewer Gaussians, where few views leave their number to ``training.min_gaussians``, and that of no depth, where one lens
    tells it."""

    iterations: Annotated[int, Range(0, 100_000)] = 1000
    """Optimisation steps of each of the two trainings, if the training has as many: after half as many noise is not memorised yet, twice
    as many decide alike. 0 = no trial."""
    fewer: Annotated[float, Range(0.01, 1)] = 0.4
    """Share of the Gaussians that is tried beside all of them; with half of 0.4 LPIPS is worse
    on all recordings of the development set."""
    fading: Annotated[float, Range(0.1, 100)] = 3.0
    """Factor on ``lambda_opacity`` and ``lambda_scale`` that is tried with it: fewer Gaussians alone bring about
    two thirds of the SSIM."""
    without_depth: Annotated[float, Range(0, 1)] = 0.5
    """Training starts without the depth that one lens tells if its loss of left-out pixels is then less than this part of that with depth.
    Thin posts before a wall have 0.1 to 0.3. Where depth is good it is 0.9 to 1.7 on the development set, and 0.7 where tools pull tissue
    between the views, as what fits one view alone foresees its pixels best. 0 = never."""
    share: Annotated[float, Range(0.1, 1)] = 0.5
    """Share of the width and height of the views, their middle, and of the Gaussians along both: a quarter of the
    pixels."""
    left_out: Annotated[float, Range(0.005, 0.5)] = 0.05
    """Share of the pixels that the trial does not see: enough to tell losses apart, too few to make the training another one."""
    block: Annotated[int, Range(1, 100, "pixels")] = 6
    """Side of the squares that they are left out in: single pixels are predicted by their neighbours, noise and all."""


@dataclass(frozen=True)
class PhotometryConfig(StageConfig):
    """The light at the camera and each view's exposure, before training."""

    distance: Annotated[float, Range(0, 2)] = 0.9
    """Likely exponent of the fall of brightness with distance: the inverse-square law at a gamma of 2.2; 2 at a gamma of 1, the most."""
    angle: Annotated[float, Range(0, 20)] = 3.0
    """Likely exponent of the fall with the cosine of the angle from the axis: that of a usual lamp."""
    response: Annotated[float, Range(0, 1)] = 0.9
    """Likely share of a change of brightness that the camera's automatic exposure evens out."""
    shoulder: Annotated[float, Range(0, 1)] = 0.5
    """How far below white the tone curve of a camera likely begins to flatten, before training finds how far; a sharper one is taken where
    views agree clearly better with it. Those of two real cameras and of the synthetic one agree best with 0.65 to 0.8, with which training
    finds highlights less well. 0 = the camera clips, as it does without light and exposure."""
    fixed_below: Annotated[float, Range(0, 1)] = 0.03
    """Standard deviation of the logarithm of exposures below which a camera's exposure may be fixed; 0 = it never is. Those that are found
    of fixed ones have up to 0.022 (0.033 where tissue moves), of automatic ones by few views 0.005 to 0.06."""
    noise: Annotated[float, Range(0.001, 1)] = 0.05
    """Standard deviation of the logarithm of a brightness: noise, and what the shape of the tissue does."""
    max_points: Annotated[int, Range(100, 1_000_000)] = 4000
    """Points whose brightness is compared between views; more cost time and tell little."""
    darkest: Annotated[int, Range(0, 254, "grey levels")] = 12
    """Brightness of the brightest channel above which a camera keeps to its curve."""
    brightest: Annotated[int, Range(1, 255, "grey levels")] = 235
    """Brightness of the brightest channel below which a camera keeps to its curve."""


@dataclass(frozen=True)
class ExtrapolationConfig(StageConfig):
    """Gaussians where no view has seen the tissue."""

    opacity: Annotated[float, Range(0.005, 0.995)] = 0.8
    """Opacity of the Gaussians: no other view may see through them, and no training makes them denser."""
    size: Annotated[float, Range(0.1, 10)] = 0.6
    """Standard deviation of a Gaussian in spacings: with smaller ones there are gaps; the nearer of larger ones hide the others where
    tissue is steep."""
    fine_reach: Annotated[float, Range(0, 1, "widths of the image")] = 0.15
    """Distance from the picture up to which Gaussians are spaced by ``interpolation.cell``; beyond it, by 1.5 times as much. Large
    Gaussians closer to the picture would cover what was seen."""
    hole_error: Annotated[float, Range(0, 1)] = 0.002
    """Holes that remain in pictures take the colour around them, unless the mean error of a training view, where white is 1, is then larger
    by this, half a level of 255, or more: their holes are dark lumens, with 0.003 to 0.014. Edges that let some black through make 0.0001
    to 0.0008. 0 = all holes are black."""
    min_coverage: Annotated[float, Range(0, 1)] = 0.02
    """Share of the pixels with depth from which on the surroundings of a view can be told."""
    brightness_ratio: Annotated[float, Range(0, 1)] = 0.9
    """Brightness tells depth where no point is near, if views then differ in colour by less than this many times as much as with depth
    that is continued from points; 0 never lets it. Along tubes the ratio is 0.37 to 1.1, of other tissue 0.96 and more."""
    brightness_holes: Annotated[float, Range(0, 1)] = 0.1
    """Share of the tissue that has to lack depth before brightness may tell it: less is rims and glints, whose surroundings tell it better,
    and too few pixels to compare views by."""
    texture: Annotated[float, Range(0.001, 0.2, "widths of the image")] = 0.02
    """Standard deviation of the blur that takes texture from brightness before it tells depth."""


@dataclass(frozen=True)
class GlossConfig(StageConfig):
    """Light that tissue reflects."""

    neighbours: Annotated[int, Range(3, 1000)] = 24
    """Nearest Gaussians that tell the surface's normal at first, and the colour below a highlight: a patch of some pixels."""
    smoothing: Annotated[float, Range(0, 1, "scene depths")] = 0.04
    """Width over which these normals are averaged where they agree; twice as much flattens slopes. 0 = not averaged."""
    widest: Annotated[float, Range(0, 640, "pixels at width 640")] = 60.0
    """Width of a highlight above which it may be a white thing, as gauze, and is left as it is; films face the lens at first where
    narrower ones are. 0 = none do."""
    sheen_sharpness: Annotated[float, Range(0.1, 999)] = 12.0
    """Of the broad lobe: half as much light 20° off."""
    glint_sharpness: Annotated[float, Range(0.1, 999)] = 150.0
    """Of the narrow lobe: half as much light 5.5° off. Twice as sharp gains nothing: films are not known better at first."""
    sheen: Annotated[float, Range(1e-3, 1)] = 0.04
    """Strength of the broad lobe at first, a share of the tissue's own light. Weak, as few views hardly tell it from the colour."""
    glint: Annotated[float, Range(1e-3, 1)] = 0.2
    """Strength of the narrow lobe at first where no view shows a highlight, likewise: enough for training to find which Gaussians glint."""
    strongest: Annotated[float, Range(1e-3, 7)] = 4.0
    """Largest strength of a lobe, in light, where that of white is 1. Highlights have more than a camera shows as white: a wide white
    middle, a steep rim. Without a limit a few Gaussians would flash when the tissue turns. A broad lobe may be as much of it as the most
    that a view sees of the lobe."""
    facing: Annotated[float, Range(0, 10)] = 0.45
    """Exponent of the cosine by which tissue that turns away grows darker: Lambert's law in encoded images, 1 / 2.2."""
    most_turning: Annotated[float, Range(1, 1e6)] = 1.5
    """How many times as much views may differ in the brightness of the same tissue if it grew darker by that cosine, too, as they do in
    the light alone, for anything to reflect: not much more, as normals err. Nothing reflects, too, where they share no tissue of known
    depth. 1e6 = reflections whatever they show."""


@dataclass(frozen=True)
class TiltedConfig(StageConfig):
    """Training that looks at the tissue from aside, too. Without it, Gaussians that no view shows come to light as tissue is pulled."""

    every: Annotated[int, Range(0, 1000)] = 4
    """Every n-th iteration also looks at the tissue from aside: a tilted camera must see it as the training view does. Not in iterations
    with a virtual camera, nor after refine_until, nor without a depth prior; with sh_degree 0 only. 0 = never."""
    weight: Annotated[float, Range(0, 1000)] = 1.0
    """Weight of what the tilted camera should see, where that of the training view is 1. With less, pulled tissue gains less."""
    angle: Annotated[float, Range(0, 80, "deg")] = 20.0
    """By how much the tilted camera is turned at most, at random."""


@dataclass(frozen=True)
class MotionSearchConfig(StageConfig):
    """Search for breath and heart in a recording, and how training corrects what was found."""

    width: Annotated[int, Range(32, 4096, "pixels")] = 320
    """Width of the images in which points are followed."""
    rate: Annotated[float, Range(1.0, 100.0, "Hz")] = 12.5
    """Images looked at in a second, at most: six for the beat of a fast heart."""
    images: Annotated[int, Range(10, 100_000)] = 300
    """Images looked at, at most: six breaths. Each takes some hundredths of a second."""
    points: Annotated[int, Range(10, 10_000)] = 400
    """Points followed at a time, one to some 200 pixels: fewer leave gaps, more follow worse corners."""
    least_travel: Annotated[float, Range(0.0, 1.0, "m")] = 0.002
    """How far one lens must go for its rays to tell depth, a fiftieth of the usual one."""
    shortest_beat: Annotated[float, Range(0.1, 60.0, "s")] = 0.4
    """Least period of a heart: 150 beats a minute."""
    shortest_breath: Annotated[float, Range(0.1, 60.0, "s")] = 1.8
    """Least period of a breath, 33 a minute, and longest of a heart by a fifth more."""
    longest_breath: Annotated[float, Range(0.1, 60.0, "s")] = 8.0
    """Longest period of a breath: seven a minute."""
    least_cycles: Annotated[float, Range(1.0, 100.0)] = 2.0
    """Periods that must be seen; one alone may be anything that moves."""
    least_explained: Annotated[float, Range(0.0, 1.0)] = 0.6
    """Share of what still points leave over that a breath must explain; a heart half of it, unless points move without a period, too."""
    least_pixels: Annotated[float, Range(0.0, 100.0, "pixels")] = 1.0
    """Root mean square that a breath must explain, in the images in which points are followed, where they drift by a third of a pixel; a
    heart a twentieth of it, as nothing else is so fast."""
    most_irregular: Annotated[float, Range(0.0, 10.0)] = 0.3
    """How far, as a part of the breath that was found, points may be from it together until it is said not to be regular: tissue is then
    a third of its way from where it is thought to be. It is then followed image by image, and a heart is looked for in what does not go
    the way of the breath."""
    nodes: Annotated[int, Range(1, 1000)] = 32
    """Places between which training corrects the shares of the motion, spread over all points. 128 made one of two patients worse."""
    learn_from: Annotated[float, Range(0.0, 1.0)] = 0.2
    """Share of the iterations after which training corrects the motion, as colours tell little before they settle; 1 = never."""
