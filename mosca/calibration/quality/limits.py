"""The limits of the quality checks, each with its reason."""

from dataclasses import dataclass


@dataclass(frozen=True)
class QualityLimits:
    """Limits beyond which a calibration is refused or gets a warning. Shares and ratios are pure numbers."""

    principal_distance_widths: tuple[float, float] = (0.2, 20.0)
    """Interior orientation: principal distance in image widths (0.2: a 136 deg lens, 20: a 3 deg one)."""
    principal_point_share: float = 0.25
    """Principal point's offset from the image's middle, as a share of its width and height."""
    aspect_error: float = 0.05
    """Deviation from square pixels."""
    corner_shift: float = 0.4
    """Shift of an image corner by distortion, as a share of the corner's distance from the principal point."""
    refused_sigma_c: float = 0.02
    """Standard deviation of the principal distance over itself (2 % is a length error of 2 % at the first move out of
    the calibrated depth)."""
    warned_sigma_c: float = 0.005
    distance_correlation: float = 0.9
    """Correlation of the principal distance with the object distance from which too little depth is reported as the
    cause."""
    changed_sigmas: float = 10.0
    """A principal distance that differs from the known one by more than this and ``changed_share`` is that of another
    lens or focus."""
    changed_share: float = 0.02
    least_redundancy: int = 8
    """Network: redundancy of a camera's equations."""
    least_equations: float = 2.0
    """Equations per unknown (with fewer than two a blunder spreads over the residuals instead of showing)."""
    least_board_views: tuple[int, int] = (3, 6)
    """Views of a plane when the principal distance is free (three tilted views determine it, Zhang 2000; six also
    show a blunder)."""
    least_board_points: float = 6.0
    """Points of a plane per image, on average."""
    least_common_points: int = 20
    """Points that connect two cameras (five determine their relative pose)."""
    least_common_views: int = 3
    """Views of a plane that connect two cameras."""
    mirror_significance: float = 1e-5
    """Mirrored planes: significance level at which the second pose is rejected."""
    mirror_relief: float = 0.2
    """Out-of-plane extent over extent from which no second pose is searched for."""
    mirror_turn_rad: float = 2e-3
    """Poses nearer to each other than this are one."""
    size_error: float = 0.03
    """Scale: relative error of the marks' image sizes that blur explains."""
    size_bias_px: float = 0.3
    """Error of these sizes that thresholds explain."""
    unit_error: float = 0.1
    """Relative difference from a ratio of units up to which a size is attributed to it."""
    distances_m: tuple[float, float] = (0.01, 100.0)
    """Nearest and farthest plausible target."""
    unit_weight: float = 3.0
    """Factor by which sigma0 may differ from 1. With 1.5 there would be warnings of clicked points, whose errors are
    only guessed (EasyWand's sample: 1.7); with 6 there would be none of unsynchronised cameras (Caliscope's: 5.9)."""
    length_sigmas: float = 3.0
    """A check length off by more than this and ``length_error`` refuses the scale."""
    length_error: float = 2e-4
    swap_ratio: float = 5.0
    """Earlier rig: factor by which exchanged names must fit better than the names as they are."""
    swap_least_px: float = 2.0
    """Misfit below which cameras are not reported as exchanged."""
    moved_sigmas: float = 6.0
    """A camera displaced by more than this and ``moved_px`` has moved."""
    moved_px: float = 0.5
    cells: tuple[int, int] = (8, 6)
    """Coverage: columns and rows of the cells of an image or of the volume."""
    warned_coverage: float = 0.33
    noted_coverage: float = 0.7
    warned_blunders: float = 0.05
    """Residuals: share of blunders among a camera's points."""
    refused_blunders: float = 0.3
    pattern_significance: float = 1e-6
    """A residual pattern is reported when it is significant and larger than both ``pattern_px`` and
    ``pattern_sigmas``."""
    pattern_px: float = 0.03
    pattern_sigmas: float = 0.3
