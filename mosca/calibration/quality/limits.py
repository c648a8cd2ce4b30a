"""The limits by which a calibration is judged, each with its reason."""

from dataclasses import dataclass


@dataclass(frozen=True)
class QualityLimits:
    """When a calibration is warned of or refused. Shares and ratios are pure numbers.

    Interior orientation, which no real camera leaves:
    ``principal_distance_widths`` in image widths (0.2: a 136 deg lens, 20: a 3 deg one); ``principal_point_share``
    of the image's width and height, from its middle (a sensor is centred far better); ``aspect_error`` of square
    pixels; ``corner_shift`` by distortion, as a share of the corner's distance from the principal point;
    ``refused_sigma_c`` and ``warned_sigma_c``: standard deviation of the principal distance over itself (2 % is
    a length error of 2 % at the first move out of the calibrated depth); ``distance_correlation`` of the
    principal distance with the distance, from which too little depth is to blame; ``changed_sigmas`` and
    ``changed_share``: a principal distance that differs from the known one by more than both was never the same
    lens at the same focus.

    Network: ``least_redundancy`` of a camera's equations, and ``least_equations`` an unknown (fewer than two and a
    mistake spreads instead of showing); ``least_board_views`` of a plane when the principal distance is free (three
    tilted views determine it, Zhang 2000; six also show a mistake); ``least_board_points`` an image on the
    average; ``least_common_points`` that join two cameras (five determine their relative pose);
    ``least_common_views`` of a plane that join two cameras.

    Mirrored planes: ``mirror_significance``, the chance at which the second pose is dropped;
    ``mirror_relief``: out-of-plane extent over extent from which no second pose is looked for;
    ``mirror_turn_rad``: poses nearer to each other than this are one.

    Sizes: ``size_error`` of the marks' images that blur explains, and ``size_bias_px`` that thresholds do;
    ``unit_error``: how near to a ratio of units a size must be to be taken for one; ``distances_m``: nearest
    and farthest target that is still plausible for metres; ``length_sigmas`` and ``length_error``: a held-out
    length beyond both refuses the scale.

    Against an earlier rig: ``swap_ratio``: how many times better an exchange must fit than the names do;
    ``swap_least_px``: misfit below which nobody was exchanged; ``moved_sigmas`` and ``moved_px``: a camera that
    left its place by more than both has moved.

    Coverage, of the cells ``cells`` (columns, rows) of an image or of the volume: ``warned_coverage`` and
    ``noted_coverage``. Residuals: ``warned_blunders`` and ``refused_blunders``, shares of a camera's points;
    ``pattern_significance``, ``pattern_px`` and ``pattern_sigmas``: a residual pattern is told when chance does
    not make it and it is larger than both.
    """

    principal_distance_widths: tuple[float, float] = (0.2, 20.0)
    principal_point_share: float = 0.25
    aspect_error: float = 0.05
    corner_shift: float = 0.4
    refused_sigma_c: float = 0.02
    warned_sigma_c: float = 0.005
    distance_correlation: float = 0.9
    changed_sigmas: float = 10.0
    changed_share: float = 0.02
    least_redundancy: int = 8
    least_equations: float = 2.0
    least_board_views: tuple[int, int] = (3, 6)
    least_board_points: float = 6.0
    least_common_points: int = 20
    least_common_views: int = 3
    mirror_significance: float = 1e-5
    mirror_relief: float = 0.2
    mirror_turn_rad: float = 2e-3
    size_error: float = 0.03
    size_bias_px: float = 0.3
    unit_error: float = 0.1
    distances_m: tuple[float, float] = (0.01, 100.0)
    length_sigmas: float = 3.0
    length_error: float = 2e-4
    swap_ratio: float = 5.0
    swap_least_px: float = 2.0
    moved_sigmas: float = 6.0
    moved_px: float = 0.5
    cells: tuple[int, int] = (8, 6)
    warned_coverage: float = 0.33
    noted_coverage: float = 0.7
    warned_blunders: float = 0.05
    refused_blunders: float = 0.3
    pattern_significance: float = 1e-6
    pattern_px: float = 0.03
    pattern_sigmas: float = 0.3
