"""Targets against the paper's text taken literally, hand numbers, and the errors that they predict."""

from dataclasses import replace

import numpy as np
import pytest
from disc_images import READ, bound_px, errors, frame
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from oracle import detect_reference as reference
from scipy import ndimage

from mosca.data.detections import UNREFINED
from mosca.detection.detect import DetectionSettings, detect, detect_set, mean_background, target_regions
from mosca.errors import InputError

PAPER = DetectionSettings(
    thresholds="paper", contrast_dn=24.0, step_dn=1, lowest_dn=16, read_noise_dn=0.13, gain_dn_per_e=0.0128
)
"""The paper's rule, with the noise of the twin's camera."""


def regions_of(image, wanted=PAPER, bit_depth=8):
    labels = target_regions(image, wanted, bit_depth)
    return {frozenset((int(x), int(y)) for y, x in np.argwhere(labels == k)) for k in range(1, labels.max() + 1)}


def regions_by_paper(image, wanted, bit_depth=8):
    scale = 2 ** (bit_depth - 8)
    levels = [scale * level for level in (wanted.contrast_dn, wanted.step_dn, wanted.lowest_dn)]
    sizes = wanted.minimum_size_px, wanted.maximum_size_px
    return set(reference.target_regions(image, 2**bit_depth - 1, *levels, *sizes))


# ---------------------------------------------------------------- equality with the paper's text

search_settings = st.builds(
    DetectionSettings,
    thresholds=st.just("paper"),
    contrast_dn=st.sampled_from([5.0, 10.0, 24.0, 24.5, 60.0]),
    step_dn=st.sampled_from([1, 2, 3, 7, 20]),
    lowest_dn=st.sampled_from([0, 3, 16, 50]),
    minimum_size_px=st.sampled_from([0.0, 1.0, 2.0]),
    maximum_size_px=st.sampled_from([4.0, 6.0, 12.0, 40.0]),
)


@settings(max_examples=150, deadline=None)
@given(
    image=hnp.arrays(
        np.uint8,
        hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=17),
        elements=st.sampled_from([0, 17, 18, 40, 43, 68, 93, 118, 200, 255]),
    ),
    wanted=search_settings,
)
def test_regions_equal_the_reference_on_any_image(image, wanted):
    assert regions_of(image, wanted) == regions_by_paper(image, wanted)


@pytest.mark.parametrize("bit_depth", [8, 12, 16])
@pytest.mark.parametrize("seed", range(12))
def test_regions_equal_the_reference_on_noise_and_merging_discs(seed, bit_depth):
    rng = np.random.default_rng([seed, bit_depth])
    height, width = rng.integers(20, 60, 2)
    y, x = np.mgrid[:height, :width]
    light = np.full((height, width), 4.0)
    for _ in range(rng.integers(2, 12)):  # dense: many touch
        centre_x, centre_y, radius = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(1, 5)
        disc = (x - centre_x) ** 2 + (y - centre_y) ** 2 < radius**2
        light = np.maximum(light, rng.uniform(30, 300) * disc)
    light = ndimage.gaussian_filter(light, rng.uniform(0.3, 1.2))
    light += rng.normal(0, [0.5, 3, 10][seed % 3], light.shape)
    scale = 2 ** (bit_depth - 8)
    image = np.clip(light * scale, 0, 256 * scale - 1).astype(np.uint8 if bit_depth == 8 else np.uint16)
    wanted = replace(
        PAPER,
        contrast_dn=float(rng.choice([10, 24, 60])),
        step_dn=int(rng.choice([1, 2, 5])),
        maximum_size_px=float(rng.choice([8, 40])),
    )
    assert regions_of(image, wanted, bit_depth) == regions_by_paper(image, wanted, bit_depth)


@pytest.mark.parametrize("seed", range(10))
def test_paper_centroid_equals_the_reference(seed):
    rng = np.random.default_rng(seed)
    light = ndimage.gaussian_filter(rng.uniform(0, 255, (40, 44)), 1.3)
    image = np.clip((light - 110) * 8, 0, 255).astype(np.uint8)
    wanted = replace(PAPER, centroid="paper", contrast_dn=10.0)
    inside = [
        region for region in regions_by_paper(image, wanted) if all(0 < x < 43 and 0 < y < 39 for x, y in region)
    ]
    expected = np.array(sorted(reference.centroid(image, region) for region in inside))
    found = detect(image, "left", wanted).xy_px
    assert len(found) == len(expected) > 3
    np.testing.assert_allclose(found[np.lexsort(found.T[::-1])], expected, atol=1e-10)


# ---------------------------------------------------------------- hand-made images, hand numbers


def small_cross():
    image = np.full((7, 7), 10, np.uint8)
    image[3, 2:5] = 50, 100, 80
    image[2, 3] = image[4, 3] = 60
    return image


def test_centroid_of_the_paper_by_hand():
    # sum I = 350; x: (2*50 + 3*(60 + 100 + 60) + 4*80) / 350; y: (2*60 + 3*230 + 4*60) / 350.
    found = detect(small_cross(), "left", replace(PAPER, centroid="paper"))
    np.testing.assert_allclose(found.xy_px, [[1080 / 350, 3.0]], rtol=1e-14)
    assert found.camera == "left"
    assert found.peak.tolist() == [100]
    assert found.elongation.tolist() == [1.0]


def test_centroid_and_covariance_over_the_background_by_hand():
    # b = 10. sum (I - b) = 300; x: (2*40 + 3*190 + 4*70) / 300 = 3.1. The mask has 3, 5, 5, 5, 3 pixels in
    # columns 1 to 5: sum (x - 3.1)^2 = 34.21, sum (x - 3.1) = -2.1; sum (x - 3.1)^2 (I - b) = 107; the
    # ring is the image's border, 24 pixels.
    wanted = replace(PAPER, read_noise_dn=0.0, gain_dn_per_e=0.5, centroid="background")
    found = detect(small_cross(), "left", wanted)
    np.testing.assert_allclose(found.xy_px, [[3.1, 3.0]], rtol=1e-14)
    var_x = (34.21 / 12 + 0.5 * 107 + 2.1**2 / (12 * 24)) / 300**2
    # In rows 1 to 5 likewise 3, 5, 5, 5, 3: sum (y - 3)^2 = 34; sum (y - 3)^2 (I - b) = 50 + 50.
    var_y = (34 / 12 + 0.5 * 100) / 300**2
    np.testing.assert_allclose(found.covariance_px2[0], [[var_x, 0], [0, var_y]], rtol=1e-12, atol=1e-18)


def test_limits_of_contrast_and_size_are_strict():
    image = small_cross()  # the region's grey values are 50 to 100, its box 3 x 3
    for accepted, change in [
        (True, {"contrast_dn": 49.9}),
        (False, {"contrast_dn": 50.0}),
        (True, {"minimum_size_px": 2.9}),
        (False, {"minimum_size_px": 3.0}),
        (True, {"maximum_size_px": 3.1}),
        (False, {"maximum_size_px": 3.0}),
    ]:
        assert len(detect(image, "left", replace(PAPER, **change))) == accepted, change


def test_single_pixels_are_never_targets():
    rng = np.random.default_rng(3)
    image = np.full((60, 60), 4, np.uint8)
    image[2:58:3, 2:58:3] = rng.integers(100, 256, (19, 19))
    assert len(detect(image, "left", PAPER)) == 0


def test_a_saturated_disc_is_one_target_at_its_centre():
    y, x = np.mgrid[:21, :21]
    radius = np.hypot(x - 10, y - 10)
    image = np.clip(600 - 100 * radius, 5, 255).astype(np.uint8)
    found = detect(image, "left", PAPER)
    np.testing.assert_allclose(found.xy_px, [[10, 10]], atol=1e-12)


def two_summits(saddle):
    image = np.full((9, 15), 4, np.uint8)
    image[3:6, 3:6] = image[3:6, 9:12] = 150
    image[4, 4] = image[4, 10] = 200
    image[4, 6:9] = saddle
    return image


def test_two_targets_that_merge_lower_down_stay_two():
    # Each is accepted by itself (contrast 50) before the saddle joins them; the paper's N is then 2, and must
    # not fall back to 1 at the next threshold, where one merged region is all that the last image had.
    squares = {frozenset((x, y) for x in range(a, a + 3) for y in range(3, 6)) for a in (3, 9)}
    assert regions_of(two_summits(saddle=100)) == squares
    assert len(detect(two_summits(saddle=100), "left", PAPER)) == 2


def test_two_summits_with_a_shallow_saddle_are_one_target():
    # Above the saddle the summits have contrast 0 and 0: nothing is accepted before they are one region.
    image = two_summits(saddle=149)
    image[4, 4] = image[4, 10] = 150
    assert len(detect(image, "left", PAPER)) == 0  # contrast 1
    image[3:6, 2] = image[3:6, 12] = 60
    assert [len(region) for region in regions_of(image)] == [27]


def test_a_noisy_plateau_is_one_target_as_long_as_noise_is_below_contrast():
    rng = np.random.default_rng(0)
    image = np.full((40, 40), 4, np.uint8)
    y, x = np.mgrid[:40, :40]
    disc = np.hypot(x - 20, y - 20) < 9
    image[disc] = rng.integers(200, 224, disc.sum())
    image[np.abs(np.hypot(x - 20, y - 20) - 9.5) < 0.5] = 100
    assert len(detect(image, "left", PAPER)) == 1


def test_a_target_on_the_border_is_dropped():
    image = np.full((12, 20), 4, np.uint8)
    image[4:7, 17:20] = 100
    image[5, 18] = 200
    assert len(regions_of(image)) == 1
    assert len(detect(image, "left", PAPER)) == 0
    assert len(detect(np.pad(image, 1, constant_values=4), "left", PAPER)) == 1


def test_a_neighbour_two_pixels_off_is_not_taken_into_the_mask():
    image = np.full((11, 17), 4, np.uint8)
    image[4:7, 4:7] = 100
    image[5, 5] = 200
    alone = detect(image, "left", replace(PAPER, dilation_px=2, centroid="background")).xy_px[0]
    image[4:7, 8:11] = 100
    image[5, 9] = 200
    found = detect(image, "left", replace(PAPER, dilation_px=2, centroid="background")).xy_px
    np.testing.assert_allclose(alone, [5, 5], atol=1e-12)
    np.testing.assert_allclose(found, [[5, 5], [9, 5]], atol=1e-12)


# ---------------------------------------------------------------- properties


def scene(seed):
    rng = np.random.default_rng(seed)
    light = np.full((70, 91), 6.0)
    y, x = np.mgrid[:70, :91]
    for _ in range(8):
        centre = rng.uniform(12, [58, 79])
        radius = rng.uniform(1.5, 5)
        light += rng.uniform(80, 200) * (np.hypot(y - centre[0], x - centre[1]) < radius)
    light = ndimage.gaussian_filter(light, 0.7) + rng.normal(0, 2.0, light.shape)
    return np.clip(np.rint(light), 0, 240).astype(np.uint8)


def by_place(detections):
    order = np.lexsort(detections.xy_px.T)
    return detections.xy_px[order], detections.covariance_px2[order], detections.diameter_px[order]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("dx", "dy"), [(1, 0), (0, 1), (5, 3), (8, 2)])
def test_a_shift_by_whole_pixels_shifts_centroids_by_whole_pixels(seed, dx, dy):
    image = scene(seed)
    moved = np.pad(image, ((dy, 9), (dx, 9)), constant_values=6)
    there, covariance, diameter = by_place(detect(moved, "left", PAPER))
    here, covariance_here, diameter_here = by_place(
        detect(np.pad(image, ((0, 9), (0, 9)), constant_values=6), "left", PAPER)
    )
    np.testing.assert_allclose(there, here + [dx, dy], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(covariance, covariance_here)
    np.testing.assert_array_equal(diameter, diameter_here)


@pytest.mark.parametrize(("centroid", "atol"), [("refined", 4e-3), ("background", 1e-12), ("paper", 1e-12)])
@pytest.mark.parametrize("seed", range(5))
def test_transposing_the_image_swaps_x_and_y(seed, centroid, atol):
    image = scene(seed)
    wanted = replace(PAPER, centroid=centroid)
    straight = detect(image, "left", wanted)
    swapped = detect(np.ascontiguousarray(image.T), "left", wanted)
    assert len(straight) == len(swapped) > 3
    for a in range(len(straight)):
        b = int(np.argmin(np.hypot(*(swapped.xy_px[:, ::-1] - straight.xy_px[a]).T)))
        if {int(straight.flags[a]), int(swapped.flags[b])} - {0, UNREFINED}:
            continue  # grown together: which pixels a neighbour takes depends on the order of positions
        np.testing.assert_allclose(swapped.xy_px[b, ::-1], straight.xy_px[a], rtol=0, atol=atol)
        np.testing.assert_allclose(
            swapped.covariance_px2[b, ::-1, ::-1], straight.covariance_px2[a], rtol=max(1e-9, 25 * atol), atol=1e-8
        )


@pytest.mark.parametrize("seed", range(5))
def test_a_constant_grey_value_changes_no_centroid_over_the_background(seed):
    image = scene(seed)
    plain = detect(image, "left", replace(PAPER, lowest_dn=20, centroid="background"))
    lifted = detect(image + np.uint8(13), "left", replace(PAPER, lowest_dn=33, centroid="background"))
    np.testing.assert_array_equal(plain.xy_px, lifted.xy_px)
    np.testing.assert_allclose(plain.covariance_px2, lifted.covariance_px2, rtol=1e-9)


@pytest.mark.parametrize("bit_depth", [10, 12, 16])
def test_settings_hold_for_the_same_scene_in_more_bits(bit_depth):
    image = scene(1)
    deep = image.astype(np.uint16) * 2 ** (bit_depth - 8)
    wanted = DetectionSettings(centroid="background")
    shallow, found = detect(image, "a", wanted), detect(deep, "a", wanted, bit_depth)
    np.testing.assert_array_equal(shallow.xy_px, found.xy_px)
    # the fit takes rounding into account, which is finer in more bits
    wanted = DetectionSettings(read_noise_dn=2.0)
    shallow, found = detect(image, "a", wanted), detect(deep, "a", wanted, bit_depth)
    whole = (shallow.flags == 0) & (found.flags == 0)
    assert whole.sum() > 2
    np.testing.assert_allclose(shallow.xy_px[whole], found.xy_px[whole], rtol=0, atol=0.03)


@pytest.mark.parametrize("width", range(60, 77))
def test_any_width_and_any_memory_layout_give_the_same(width):
    image = scene(2)
    cut = image[3:, 5 : 5 + width]
    expected = regions_by_paper(cut, PAPER)
    assert regions_of(cut) == expected
    assert regions_of(np.asfortranarray(cut)) == expected
    assert regions_of(cut.astype(np.uint16), bit_depth=8) == expected


def test_a_set_of_images_of_several_types_and_sizes_and_an_empty_one():
    one, other = scene(0), scene(1)[:50].astype(np.uint16)
    for found, alone in zip(
        detect_set([one, other], ["a", "b"]), (detect(one, "a"), detect(other, "b")), strict=True
    ):
        np.testing.assert_array_equal(found.xy_px, alone.xy_px)
    assert detect_set([], []) == []


def test_images_without_light_give_no_targets():
    assert len(detect(np.zeros((10, 12), np.uint8), "left")) == 0
    assert len(detect(np.full((10, 12), 255, np.uint8), "left")) == 0
    assert len(detect(np.zeros((1, 1), np.uint16), "left", bit_depth=16)) == 0


# ---------------------------------------------------------------- background


def test_a_background_image_takes_off_what_does_not_move():
    image = scene(3)
    lamp = np.zeros_like(image)
    lamp[30:36, 40:46] = 150
    lamp[32, 43] = 190
    lit = np.maximum(image, lamp)
    frames = [np.maximum(lamp, np.uint8(5 + k)) for k in (0, 1, 1)]
    background = mean_background(frames)
    assert background.dtype == np.uint8
    assert background[0, 0] == 6  # (5 + 6 + 6) / 3 = 5.67
    assert len(detect(lit, "left", PAPER, background=background)) < len(detect(lit, "left", PAPER))
    wiped = lit.astype(int) - background
    # the same targets; centres differ by the lamp's light that a target hides
    np.testing.assert_allclose(
        detect(lit, "left", PAPER, background=background).xy_px,
        detect(np.clip(wiped, 0, 255).astype(np.uint8), "left", PAPER).xy_px,
        atol=0.01,
    )


# ---------------------------------------------------------------- errors of the user


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: replace(PAPER, contrast_dn=0), "contrast_dn"),
        (lambda: replace(PAPER, lowest_dn=243), "lowest_dn"),
        (lambda: replace(PAPER, step_dn=0), "step_dn"),
        (lambda: DetectionSettings(minimum_size_px=70), "minimum_size_px"),
        (lambda: DetectionSettings(centroid="middle"), "middle"),
        (lambda: DetectionSettings(dilation_px=3), "dilation_px"),
        (lambda: DetectionSettings(gain_dn_per_e=float("nan")), "gain_dn_per_e"),
        (lambda: detect(np.zeros((4, 4, 3), np.uint8), "left"), "left.*reduce colour"),
        (lambda: detect(np.zeros((4, 4)), "left"), "float64"),
        (lambda: detect(np.zeros((4, 4), np.uint8), "left", bit_depth=12), "bit_depth 12"),
        (lambda: detect(np.zeros((4, 4), np.uint8), "left", background=np.zeros((4, 5), np.uint8)), "background"),
        (lambda: detect_set([np.zeros((4, 4), np.uint8)], ["a", "b"]), "1 images, 2 cameras"),
        (lambda: mean_background([]), "no images"),
        (lambda: mean_background([np.zeros((4, 4), np.uint8), np.zeros((4, 5), np.uint8)]), "image 1"),
    ],
)
def test_errors_say_what_is_wrong_in_one_line(call, words):
    with pytest.raises(InputError, match=words) as caught:
        call()
    assert "\n" not in str(caught.value)


# ---------------------------------------------------------------- accuracy on discs made elsewhere


def errors_on_discs(diameter, blur, contrast, snr, n=864, **change):
    """Detect n discs at random positions: errors and predicted variances (n, 2), phases, diameters, bound."""
    image, truth, gain = frame(np.random.default_rng(0), diameter, blur, contrast, snr, n)
    wanted = replace(PAPER, **{"centroid": "background", **change}, read_noise_dn=READ, gain_dn_per_e=gain)
    found = detect(image, "left", wanted)
    assert len(found) == len(truth)
    away, variances = errors(found, truth)
    place = found.xy_px - away
    bound = np.sqrt(np.mean(bound_px(diameter, blur, contrast, gain) ** 2))
    return away, variances, (place + 0.5) % 1 - 0.5, found.diameter_px, bound


# Measured (rms error over the bound): 1.04-1.32 for 3 to 8 px; a centroid cannot be better on a sharp disc of
# 12 px with photon noise, whose middle has no information on its position: 1.33-1.50.
@pytest.mark.parametrize("snr", [50, 100])
@pytest.mark.parametrize("blur", [0.5, 0.7])
@pytest.mark.parametrize(("diameter", "limit"), [(3, 1.38), (5, 1.35), (8, 1.38), (12, 1.6)])
def test_error_is_near_the_cramer_rao_bound_unbiased_and_as_predicted(diameter, limit, blur, snr):
    away, variances, phases, diameters, bound = errors_on_discs(diameter, blur, 200, snr)
    assert np.sqrt(np.mean(away**2)) < limit * bound
    # Bias over eight bins of the sub-pixel phase: 216 errors a bin leave 0.0007 px of noise at 0.01 px rms.
    for low in np.arange(-0.5, 0.5, 0.125):
        assert abs(np.mean(away[(phases >= low) & (phases < low + 0.125)])) < 0.005
    # 1,728 errors: chi-square / n has a standard deviation of 0.034. Measured 0.94-1.06.
    assert 0.87 < np.mean(away**2 / variances) < 1.13
    assert np.mean(diameters) == pytest.approx(diameter, rel=0.07)


# Measured: 1.03, 1.03, 1.12, 1.40, 1.83. The largest grey value, and with it the noise, enters the diameter.
@pytest.mark.parametrize(
    ("diameter", "blur", "limit"), [(2.5, 0.7, 1.3), (4, 0.5, 1.3), (6, 0.7, 1.3), (10, 0.6, 1.6), (20, 0.6, 2)]
)
def test_strong_noise_is_measured_as_predicted_where_contrast_is_set_above_it(diameter, blur, limit):
    # SNR 20 at 200 DN is 10 DN: B = 24 would split plateaus, so B is well above five times the noise.
    away, variances, _, diameters, bound = errors_on_discs(diameter, blur, 200, 20, 432, contrast_dn=70.0)
    assert np.sqrt(np.mean(away**2)) < limit * bound
    assert 0.82 < np.mean(away**2 / variances) < 1.2
    assert np.mean(diameters) == pytest.approx(diameter, rel=0.13)


def test_without_dilation_the_centroid_is_biased():
    """The control: the same limits do not hold for a mask that cuts off the disc's edge."""
    away, variances, *_, bound = errors_on_discs(5, 0.7, 200, 100, dilation_px=0)
    assert np.sqrt(np.mean(away**2)) > 2 * bound
    assert np.mean(away**2 / variances) > 3
