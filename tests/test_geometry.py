import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.geometry.camera import Camera
from robotd.geometry.transforms import (
    invert_rigid,
    pose_matrix,
    rotation_matrix,
    rotation_vector,
    se2_compose,
    se2_inverse,
    se2_relative,
    transform_matrix,
    transform_points,
    transform_record,
    wrap_angle,
)
from robotd.records import CameraModel, Transform

HERE = Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
K = (268.5, 270.0, 319.5, 239.5)
LENSES = {
    "rig": (-0.06, 0.012, 0.0002, 0.0002, -0.001),
    "four": (-0.06, 0.012, 0.0002, 0.0002),
    "folding": (-0.3, 0.1, 0.001, -0.0005, -0.02),
    "rational": (0.2, -0.05, 0.0002, 0.0003, 0.01, 0.25, -0.03, 0.012),
}
FISHEYE = (0.05, -0.02, 0.003, -0.001)
K_MATRIX = np.array([[K[0], 0.0, K[2]], [0.0, K[1], K[3]], [0.0, 0.0, 1.0]])

angles = st.floats(-30.0, 30.0)
coordinates = st.floats(-5.0, 5.0)
poses = st.tuples(coordinates, coordinates, angles)


def camera(distortion, model="brown-conrady", **changes):
    return Camera(CameraModel("test", (640, 480), K, HERE, model, distortion, **changes))


def directions(count, seed=0, spread=1.0):
    return np.random.default_rng(seed).normal(size=(count, 3)) * [spread, spread, 0.2] + [0.0, 0.0, 1.2]


@given(angles)
def test_wrapped_angles_are_equal_and_in_the_half_open_interval(angle):
    wrapped = wrap_angle(angle)
    assert -np.pi < wrapped <= np.pi
    assert np.isclose(np.exp(1j * wrapped), np.exp(1j * angle))


def test_a_half_turn_wraps_to_plus_pi():
    assert wrap_angle(-np.pi) == np.pi
    np.testing.assert_array_equal(wrap_angle(np.array([np.pi, -np.pi])), np.pi)


@settings(deadline=None)
@given(st.tuples(coordinates, coordinates, coordinates), st.sampled_from([1e-12, 1e-8, 1e-3, 1.0, 3.0, np.pi - 1e-9]))
def test_rotation_vectors_survive_the_matrix_near_zero_and_near_pi(axis, angle):
    length = np.linalg.norm(axis)
    if length < 1e-3:
        return
    vector = np.array(axis) / length * angle
    R = rotation_matrix(vector)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(rotation_vector(R), vector, rtol=1e-7, atol=1e-14)


def test_rotations_agree_with_opencv_in_stacks():
    vectors = np.random.default_rng(1).normal(size=(20, 3))
    np.testing.assert_allclose(rotation_matrix(vectors), [cv2.Rodrigues(v)[0] for v in vectors], atol=1e-14)


def test_exact_half_turns_have_angle_pi():
    for axis in np.eye(3):
        R = 2.0 * np.outer(axis, axis) - np.eye(3)
        np.testing.assert_allclose(np.abs(rotation_vector(R)), np.pi * axis, atol=1e-12)


@given(poses, poses)
def test_relative_planar_pose_composes_back(a, b):
    back = se2_compose(a, se2_relative(a, b))
    np.testing.assert_allclose(back[:2], b[:2], atol=1e-12)
    assert np.isclose(np.exp(1j * back[2]), np.exp(1j * b[2]))
    np.testing.assert_allclose(se2_compose(a, se2_inverse(a)), 0.0, atol=1e-12)


@given(poses, poses)
def test_planar_and_spatial_composition_agree(a, b):
    np.testing.assert_allclose(pose_matrix(*a) @ pose_matrix(*b), pose_matrix(*se2_compose(a, b)), atol=1e-9)


def test_positive_pitch_lowers_the_front_and_positive_roll_the_right_side():
    assert (pose_matrix(0.0, 0.0, 1.0, 0.0, 0.1) @ [1.0, 0.0, 0.0, 1.0])[2] < 0.0
    assert (pose_matrix(0.0, 0.0, 1.0, 0.1, 0.0) @ [0.0, -1.0, 0.0, 1.0])[2] < 0.0


def test_heading_turns_counter_clockwise_from_x():
    np.testing.assert_allclose(
        transform_points(pose_matrix(1.0, 2.0, np.pi / 2), [[1.0, 0.0, 0.5]]), [[1.0, 3.0, 0.5]], atol=1e-15
    )


def test_transform_records_and_inverses_round_trip():
    record = Transform((0.3, -1.2, 0.7), (0.1, 0.2, 0.3))
    T = transform_matrix(record)
    back = transform_record(T)
    np.testing.assert_allclose(back.rotation, record.rotation)
    assert back.translation == record.translation
    np.testing.assert_allclose(invert_rigid(T) @ T, np.eye(4), atol=1e-15)


@pytest.mark.parametrize("lens", LENSES)
def test_projection_agrees_with_opencv(lens):
    points = directions(500)
    pixels, valid = camera(LENSES[lens]).project(points)
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K_MATRIX, np.array(LENSES[lens]))[0][:, 0]
    assert valid.mean() > 0.6
    np.testing.assert_allclose(pixels[valid], expected[valid], atol=1e-9)


def test_fisheye_projection_agrees_with_opencv():
    points = directions(500)
    pixels, valid = camera(FISHEYE, "fisheye").project(points)
    expected = cv2.fisheye.projectPoints(points[None], np.zeros(3), np.zeros(3), K_MATRIX, np.array(FISHEYE))[0][0]
    ahead = points[:, 2] > 0.0
    np.testing.assert_allclose(pixels[valid & ahead], expected[valid & ahead], atol=1e-9)


@pytest.mark.parametrize(
    ("distortion", "model"), [*((d, "brown-conrady") for d in LENSES.values()), (FISHEYE, "fisheye")]
)
def test_rays_point_back_at_what_was_projected(distortion, model):
    lens = camera(distortion, model)
    points = directions(2000, seed=3)
    pixels, valid = lens.project(points)
    rays, known = lens.rays(pixels[valid])
    unit = points[valid] / np.linalg.norm(points[valid], axis=1)[:, None]
    assert known.mean() > 0.95
    np.testing.assert_allclose(rays[known], unit[known], atol=1e-12)


@pytest.mark.parametrize(
    ("distortion", "model"), [*((d, "brown-conrady") for d in LENSES.values()), (FISHEYE, "fisheye")]
)
def test_projection_derivatives_agree_with_finite_differences(distortion, model):
    lens = camera(distortion, model)
    points = directions(200, seed=4, spread=0.6)
    _, jacobian, valid = lens.project_jacobian(points)
    for k in range(3):
        ahead, behind = points.copy(), points.copy()
        ahead[:, k] += 1e-6
        behind[:, k] -= 1e-6
        slope = (lens.project(ahead)[0] - lens.project(behind)[0]) / 2e-6
        np.testing.assert_allclose(jacobian[valid, :, k], slope[valid], rtol=1e-5, atol=1e-3)


def test_points_and_pixels_beyond_the_fold_are_refused():
    lens = camera(LENSES["folding"])
    inside, outside = lens.limit * 0.99, lens.limit * 1.01
    _, valid = lens.project([[inside, 0.0, 1.0], [outside, 0.0, 1.0]])
    assert valid.tolist() == [True, False]
    # the model does bend this point back to a pixel that a nearer one has as well
    bent = cv2.projectPoints(
        np.array([[2.0, 0.0, 1.0]]), np.zeros(3), np.zeros(3), K_MATRIX, np.array(LENSES["folding"])
    )
    assert bent[0][0, 0, 0] < lens.project([[inside, 0.0, 1.0]])[0][0, 0]
    rays, known = lens.rays([[K[2] + 300.0, K[3]], [K[2] + 100.0, K[3]]])
    assert known.tolist() == [False, True]
    assert np.isnan(rays[0]).all()


def test_points_behind_the_camera_and_not_numbers_are_refused():
    lens = camera(LENSES["rig"])
    _, valid = lens.project([[0.0, 0.0, -1.0], [np.nan, 0.0, 1.0], [0.1, 0.0, 1.0]])
    assert valid.tolist() == [False, False, True]
    assert lens.rays([[np.nan, 1.0]])[1].tolist() == [False]


def test_the_stated_valid_radius_is_kept():
    lens = camera(LENSES["rig"], valid_radius_px=100.0)
    assert lens.rays([[K[2] + 99.0, K[3]], [K[2] + 101.0, K[3]]])[1].tolist() == [True, False]
    pixels, valid = lens.project([[0.3, 0.0, 1.0], [0.5, 0.0, 1.0]])
    assert valid.tolist() == [True, False]
    assert np.isnan(pixels[1]).all()


def test_the_rig_lens_covers_its_whole_image():
    corners = [[0, 0], [639, 0], [0, 479], [639, 479]]
    assert camera(LENSES["rig"]).rays(corners)[1].all()


def test_a_forward_camera_sees_what_is_left_of_the_robot_on_the_left():
    front = Transform((-1.2091995761561452, 1.2091995761561452, -1.2091995761561452), (0.06, 0.0, 0.5))
    lens = Camera(CameraModel("front", (640, 480), K, front))
    (ahead, left), valid = lens.project(transform_points(invert_rigid(lens.T_robot_camera), [[3, 0, 0.5], [3, 1, 1.0]]))
    assert valid.all()
    np.testing.assert_allclose(ahead, K[2:], atol=1e-9)
    assert left[0] < K[2]
    assert left[1] < K[3]


def test_impossible_calibrations_are_refused():
    with pytest.raises(ValueError, match="3 distortion coefficients"):
        camera((0.1, 0.0, 0.0))
    with pytest.raises(ValueError, match="focal lengths must be positive"):
        Camera(CameraModel("test", (640, 480), (0.0, 1.0, 0.0, 0.0), HERE))
    with pytest.raises(ValueError, match="unknown lens model"):
        camera((), "pinhole")
    with pytest.raises(ValueError, match=r"shape \(N, 3\)"):
        camera(()).project([1.0, 2.0, 3.0])


def test_pixels_are_in_the_image_up_to_half_a_pixel_outside_their_centres():
    lens = camera(LENSES["rig"])
    assert lens.in_image([[-0.5, 0.0], [-0.6, 0.0], [639.4, 479.4], [640.0, 0.0]]).tolist() == [
        True,
        False,
        True,
        False,
    ]
    assert lens.in_image([[5.0, 5.0]], margin=6.0).tolist() == [False]
