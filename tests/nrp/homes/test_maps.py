"""Maps and their files: cells, ROS's map_server, MJCF scenes, and what is refused."""

import warnings

import mujoco
import numpy as np
import pytest
from PIL import Image

import nrp_jax
from nrp_jax.homes import mjcf_map
from nrp_jax.homes.grid import coarsened, load_map
from vrrt_jax.core import memory

ROS = "image: home.png\nresolution: 0.1\norigin: [-1.0, -2.0, 0.0]\n"


def ros(folder, pixels, text="", base=ROS):
    """The free pixels (H, W), as in the image, of a map of 0.1 m with a YAML file."""
    Image.fromarray(np.asarray(pixels, np.uint8)).save(folder / "home.png")
    (folder / "home.yaml").write_text(base + text)
    return ~load_map(folder / "home.yaml").occupied[:, ::-1, 0].T


def scene(folder, geoms, rest=""):
    """The map of an MJCF scene."""
    text = f"<mujoco>{rest}<worldbody>{geoms}</worldbody></mujoco>"
    (folder / "scene.xml").write_text(text)
    return load_map(folder / "scene.xml")


def test_flatten_crop_and_save(tmp_path):
    occupied = np.zeros((20, 30, 20), bool)
    occupied[3, 4, 15], occupied[5, 6, 2] = True, True
    grid = nrp_jax.Grid(occupied=occupied, origin=(1.0, 2.0, 0.0))
    assert np.argwhere(grid.flatten().occupied).tolist() == [[5, 6, 0]]
    assert np.argwhere(grid.flatten(1.0, 2.0).occupied).tolist() == [[3, 4, 0]]
    part = grid.crop((1.5, 2.5), (2.0, 3.0))
    assert part.occupied.shape == (5, 5, 20) and part.origin == (1.5, 2.5, 0.0)
    assert np.argwhere(part.occupied).tolist() == [[0, 1, 2]]
    grid.save(tmp_path / "map.npz")
    again = load_map(tmp_path / "map.npz")
    np.testing.assert_array_equal(again.occupied, occupied)
    assert again.origin == grid.origin and again.resolution == grid.resolution


def test_mjcf_scene_in_cells(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(
        "<mujoco><worldbody><geom type='plane' size='5 5 .1'/>"
        "<geom type='box' pos='1 1 .5' size='.5 .05 .5'/>"
        "<geom type='sphere' pos='.05 .05 1.05' size='.04'/></worldbody></mujoco>"
    )
    grid = load_map(path)
    low = np.argwhere(grid.occupied) * 0.1 + grid.origin
    in_box = (low > [0.49, 0.89, -0.01]).all(axis=1)
    assert grid.occupied.shape[2] == 20
    assert in_box.sum() == 10 * 2 * 10  # y from 0.95 to 1.05 m meets two layers of cells
    np.testing.assert_allclose(low[~in_box], [[0.0, 0.0, 1.0]], atol=1e-6)


@pytest.mark.parametrize(
    ("occupied", "resolution", "message"),
    [
        (np.zeros(5), 0.1, r"shape \(5,\); expected \(X, Y\) or \(X, Y, Z\)"),
        (np.zeros((0, 5)), 0.1, "with cells in it"),
        (np.full((4, 4), 0.5), 0.1, "apply a threshold"),
        (np.zeros((4, 4)), 0.0, "resolution is 0.0"),
        (np.zeros((4, 4)), np.nan, "resolution is nan"),
    ],
)
def test_bad_maps(occupied, resolution, message):
    with pytest.raises(ValueError, match=message):
        nrp_jax.Grid(occupied=occupied, resolution=resolution)


def test_a_grid_from_other_kinds_of_arrays():
    grid = nrp_jax.Grid(occupied=np.eye(4), origin=(1, 2))  # type: ignore
    assert grid.occupied.shape == (4, 4, 1) and grid.occupied.dtype == bool
    assert grid.origin == (1.0, 2.0, 0.0) and grid.planar
    with pytest.raises(ValueError, match=r"origin is \(1.0,\); expected x, y"):
        nrp_jax.Grid(occupied=np.eye(4), origin=(1.0,))


def test_bad_map_files(tmp_path):
    with pytest.raises(FileNotFoundError, match="does not exist"):
        load_map(tmp_path / "none.npz")
    (tmp_path / "map.txt").write_text("")
    with pytest.raises(ValueError, match="unknown kind"):
        load_map(tmp_path / "map.txt")
    (tmp_path / "map.npz").write_text("not a zip")
    with pytest.raises(ValueError, match="no readable .npz"):
        load_map(tmp_path / "map.npz")
    with pytest.raises(ValueError, match="cells are 0.3 m"):
        coarsened(nrp_jax.Grid(occupied=np.zeros((3, 3)), resolution=0.3))
    with pytest.raises(ValueError, match="needs a map with heights"):
        flat = nrp_jax.Grid(occupied=np.zeros((30, 30)))
        nrp_jax.build_world(nrp_jax.load_robot("fetch"), flat)


@pytest.mark.parametrize(
    ("color", "negate", "free"),
    [
        ((255, 255, 0), 0, False),  # mean 170: unknown
        ((0, 0, 255), 1, False),
        ((230, 230, 230), 0, True),
        ((205, 205, 205), 0, False),
        ((255, 255, 255, 255), 0, True),  # trinary averages alpha in
        ((255, 255, 255, 0), 0, False),
        ((255, 255, 255, 200), 0, True),
        ((0, 0, 0, 255), 0, False),
    ],
)
def test_the_mean_of_the_channels_counts(tmp_path, color, negate, free):
    found = ros(tmp_path, np.full((3, 4, len(color)), color), f"negate: {negate}\n")
    assert found.shape == (3, 4) and (found == free).all()


def test_the_modes_of_a_ros_map(tmp_path):
    gray = np.array([[254, 205, 150, 80, 0, 20]])
    assert ros(tmp_path, gray, "mode: trinary\n").tolist() == [[True] + [False] * 5]
    assert ros(tmp_path, gray, "mode: Scale\n").tolist() == [[True] + [False] * 5]
    assert ros(tmp_path, gray, "mode: raw\n").tolist() == [[False] * 4 + [True, False]]
    clear = np.full((1, 2, 4), 255)
    clear[0, 0, 3] = 254  # not quite opaque: unknown
    assert ros(tmp_path, clear, "mode: scale\n").tolist() == [[False, True]]


@pytest.mark.parametrize(
    ("spelling", "negated"),
    [("0", 0), ("1", 1), ("true", 1), ("False", 0), ("yes", 1), ("off", 0), ('"1"', 1), ("n", 0)],
)
def test_negate_in_any_spelling(tmp_path, spelling, negated):
    found = ros(tmp_path, [[254, 0]], f"negate: {spelling}\n")
    assert found.tolist() == [[not negated, bool(negated)]]


def test_thresholds_are_those_of_the_file(tmp_path):
    gray = [[240, 170, 128, 0]]  # 170 is solid by a third
    assert ros(tmp_path, gray, "free_thresh: 0.4\n").tolist() == [[True, True, False, False]]
    assert ros(tmp_path, gray, "free_thresh: 0.9\n").tolist() == [[True, True, True, False]]
    assert ros(tmp_path, gray, "occupied_thresh: 2e-1\nfree_thresh: 0.9\n").sum() == 1
    with pytest.warns(UserWarning, match="gray 205 .* is free as free_thresh is 0.25"):
        assert ros(tmp_path, [[254, 205]], "free_thresh: 0.25\n").all()
    with pytest.warns(UserWarning, match="counts the alpha channel too; save the image without"):
        assert ros(tmp_path, [[[205, 205, 205, 255]]]).all()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("resolution: 0.1", "resolution: -0.1", "resolution is -0.1; expected meters"),
        ("resolution: 0.1", "resolution: 0", "resolution is 0.0; expected meters"),
        ("resolution: 0.1", "resolution: fine", "resolution has 'fine'; expected a finite number"),
        ("resolution: 0.1", "resolution: .nan", "resolution has nan"),
        ("resolution: 0.1\n", "", "with image, resolution and origin; it has: image, origin"),
        ("[-1.0, -2.0, 0.0]", "[-1.0, -2.0]", "expected x, y and yaw"),
        ("[-1.0, -2.0, 0.0]", "3", "expected x, y and yaw"),
        ("[-1.0, -2.0, 0.0]", "[a, 0, 0]", "origin has 'a'"),
        ("[-1.0, -2.0, 0.0]", "[.nan, 0, 0]", "origin has nan"),
        ("[-1.0, -2.0, 0.0]", "[0, 0, 0.3]", "turned by 0.3 rad"),
        ("home.png", "none.png", "none.png' does not exist"),
        ("home.png", "home.yaml", "cannot be read"),
        ("home.png", "", "image is None"),
        ("image", "mode: probability\nimage", "mode is 'probability'; expected one of trinary"),
        ("image", "mode: raw\nnegate: 1\nimage", "mode is raw and negate is set"),
        ("image", "negate: 3\nimage", "negate is 3; expected 0 or 1"),
        ("image", "free_thresh: 65\nimage", "free_thresh is 65.0; expected a share"),
        ("image", "{image", "not a YAML file"),
        ("image", "negate: 0\nnegate: 1\nimage", "the field 'negate' is there twice"),
    ],
)
def test_malformed_ros_maps(tmp_path, old, new, message):
    assert old in ROS
    with pytest.raises(ValueError, match=message):
        ros(tmp_path, [[254]], base=ROS.replace(old, new, 1))


def test_what_a_ros_map_says_in_vain_is_told(tmp_path):
    with pytest.warns(UserWarning, match="the fields negat of 'home.yaml' are not used"):
        assert ros(tmp_path, [[254, 0]], "negat: 1\n").tolist() == [[True, False]]
    with pytest.warns(UserWarning, match="all of its 2 cells are solid"):
        ros(tmp_path, [[1, 0]])


def test_scenes_that_cannot_be_meant_so_are_refused(tmp_path, monkeypatch):
    floor, box = '<geom type="plane" size="3 3 1"/>', '<geom type="box" size="1 1 1" pos="0 2 1"/>'
    with pytest.raises(ValueError, match="nothing of it is solid from its floor up to 2 m above"):
        scene(tmp_path, floor + box + floor.replace("plane", 'plane" pos="0 0 3'))
    monkeypatch.setattr(mjcf_map, "_MOST_CELLS", 7999.0)
    with pytest.raises(ValueError, match=r"8e\+03 cells of 0.1 m .* give lengths in meters"):
        scene(tmp_path, floor + box)


def test_a_deep_image_is_refused(tmp_path):
    Image.fromarray(np.full((4, 4), 9000, np.uint16)).save(tmp_path / "home.png")
    (tmp_path / "home.yaml").write_text(ROS)
    with pytest.raises(ValueError, match="expected 8 bits a pixel"):
        load_map(tmp_path / "home.yaml")


@pytest.mark.parametrize("nominal", ["0.05", "0.025", "0.02", "0.1"])
def test_nearly_the_same_resolution_is_the_same_map(tmp_path, nominal, rng):
    gray = np.where(rng.random((60, 2000)) < 0.02, 0, 254)
    found = []
    for resolution in (nominal, f"{np.float32(nominal):.10f}", repr(float(np.float32(nominal)))):
        base = ROS.replace("0.1", resolution)
        found.append(ros(tmp_path, gray, base=base))
    assert 0.01 < 1 - found[0].mean() < 0.7
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


def test_cells_of_a_third_make_no_double_walls():
    occupied = np.zeros((30_000, 3), bool)
    occupied[::300] = True
    for resolution in (0.1 / 3, 0.0333333):
        found = coarsened(nrp_jax.Grid(occupied=occupied, resolution=resolution)).occupied
        assert np.flatnonzero(found[:, 0, 0]).tolist() == list(range(0, 10_000, 100))


@pytest.mark.parametrize("resolution", [0.1, 0.05, 0.03])
@pytest.mark.parametrize("kind", ["yaml", "npz"])
def test_a_crop_reads_the_same_cells(tmp_path, rng, resolution, kind):
    gray = np.where(rng.random((211, 180)) < 0.03, 0, 254)
    ros(tmp_path, gray, base=ROS.replace("0.1", str(resolution)))
    grid = nrp_jax.Grid(
        occupied=(gray == 0)[::-1].T, resolution=resolution, origin=(-1.0, -2.0, 0.0)
    )
    grid.save(tmp_path / "home.npz")
    path = tmp_path / f"home.{kind}"
    whole, crop = load_map(path), (0.5, -1.2, 2.5, 1.3)
    part, expected = load_map(path, crop=crop), whole.crop(crop[:2], crop[2:])
    np.testing.assert_array_equal(part.occupied, expected.occupied)
    np.testing.assert_allclose(part.origin, expected.origin, atol=1e-9)
    with pytest.raises(ValueError, match="nothing of the map lies"):
        load_map(path, crop=(90, 90, 91, 91))


def test_a_huge_image_is_read_in_part(tmp_path):
    """More pixels than PIL takes for safe."""
    Image.new("1", (20_000, 9_000), 1).save(tmp_path / "home.png")
    (tmp_path / "home.yaml").write_text(ROS.replace("0.1", "0.02"))
    assert load_map(tmp_path / "home.yaml", crop=(0, 0, 3, 2)).occupied.shape == (30, 20, 1)


def test_a_map_too_large_for_the_memory_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda: 20_000_000)
    large = nrp_jax.Grid(occupied=np.zeros((1000, 1000), bool))
    message = "a map of 1000 x 1000 cells needs .* GiB .*: use a part of the map, as --crop"
    with pytest.raises(ValueError, match=message):
        nrp_jax.build_world(nrp_jax.load_robot("snake"), large)
    monkeypatch.setattr(memory, "free_memory", lambda: 1000)
    with pytest.raises(ValueError, match="image of 200 x 50 pixels needs"):
        ros(tmp_path, np.zeros((50, 200)))
    with pytest.raises(ValueError, match="a map of 5000 x"):
        scene(tmp_path, "<geom type='box' size='250 .1 1'/>")
    monkeypatch.undo()
    part = load_map(tmp_path / "scene.xml", crop=(-1, -9, 2, 9))
    assert part.occupied.shape == (30, 2, 20) and part.origin[0] == pytest.approx(-1)


def test_planes_are_solid_behind(tmp_path):
    """In any direction; the floor is below all cells."""
    box = "<geom type='box' pos='2 0 .5' size='2 .1 .5'/><geom type='plane' size='9 9 1'/>"
    box += "<geom type='box' pos='2 4 .5' size='2 .1 .5'/>"
    upright = scene(tmp_path, f"{box}<geom type='plane' size='0 0 1' pos='2 0 1' zaxis='-1 0 0'/>")
    assert not upright.occupied[:20, 5:-5].any() and upright.occupied[20:].all()
    # In a turned body; every corner that is deep behind it is solid, every one before it is not.
    tilted = scene(
        tmp_path,
        f"{box}<body pos='2 2 0' euler='0 0 30'><geom type='plane' size='0 0 1' pos='.5 0 0'"
        " zaxis='-1 0 .4'/></body>",
        "<compiler angle='degree'/>",
    )
    middle = (np.argwhere(np.ones(tilted.occupied.shape)) + 0.5) * 0.1 + tilted.origin
    normal = np.array([-np.cos(np.pi / 6), -np.sin(np.pi / 6), 0.4]) / np.hypot(1, 0.4)
    height = (middle - [2, 2, 0]) @ normal + 0.5 / np.hypot(1, 0.4)
    solid = tilted.occupied.reshape(-1)
    between = (middle[:, 1] > 0.2) & (middle[:, 1] < 3.8)
    assert solid[height < -0.01].all() and not solid[between & (height > 0.09)].any()
    assert 0.1 < solid.mean() < 0.9


@pytest.mark.parametrize("height", [-0.4, 0.0, 0.001, 0.3])
@pytest.mark.parametrize("tilt", [0.0, 0.0008])  # 90 degrees as 1.57 rad
def test_heights_are_those_above_the_floor(tmp_path, height, tilt):
    geoms = f"""<geom type='plane' size='0 0 1' pos='0 0 -9'/>
        <body pos='0 0 {height}' euler='0 {tilt} 0'><geom type='plane' size='9 9 1'/></body>
        <geom type='box' pos='2 2 {height + 0.5}' size='.2 .2 .1'/>"""
    low = np.argwhere(scene(tmp_path, geoms).occupied)[:, 2]
    assert low.min() == 4 and low.max() == 5


def test_thin_geoms_between_cells_are_solid(tmp_path):
    for half in (1e-9, 1e-5, 4e-5):
        sheet = f"<geom type='box' pos='1 1 .5' size='{half} 1 .5'/>"
        post = f"<geom type='capsule' fromto='3 1 0 3 1 1' size='{half}'/>"
        found = scene(tmp_path, sheet + post + "<geom type='box' pos='4 1 .5' size='.5 .5 .5'/>")
        solid = np.argwhere(found.occupied[:, :, :10].any(axis=2)) + np.round(
            np.array(found.origin[:2]) / 0.1
        ).astype(int)
        assert {*map(tuple, solid)} == (
            {(x, y) for x in (9, 10) for y in range(20)}
            | {(x, y) for x in (29, 30) for y in (9, 10)}
            | {(x, y) for x in range(35, 45) for y in range(5, 15)}
        ), half


def test_a_room_of_planes_only(tmp_path):
    walls = "".join(
        f"<geom type='plane' size='0 0 1' pos='{x} {y} 0' zaxis='{-x} {-y} 0'/>"
        for x, y in ((3, 0), (-3, 0), (0, 2), (0, -2))
    )
    grid = scene(tmp_path, f"{walls}<geom type='plane' size='0 0 1'/>")
    assert grid.occupied.shape == (60, 40, 20) and not grid.occupied.any()
    with pytest.raises(ValueError, match="no geom to collide with but floors"):
        scene(tmp_path, "<geom type='plane' size='0 0 1'/>")


def test_turned_geoms_fill_what_mujoco_says(tmp_path):
    """Geoms of all kinds in nested bodies, but not what is only drawn."""
    asset = "<asset><mesh name='m' vertex='0 0 0  .5 0 0  0 .5 0  0 0 .5'/></asset>"
    shapes = (
        ("box", "size='.3 .1 .2'"), ("capsule", "size='.1 .2'"), ("cylinder", "size='.2 .3'"),
        ("ellipsoid", "size='.3 .1 .2'"), ("mesh", ""),
    )  # fmt: skip
    for kind, size in shapes:
        geoms = f"""<body pos='1 1 .8' euler='20 30 40'><body pos='.1 0 0' euler='0 50 0'>
            <geom name='cell' type='{kind}' {size} {"mesh='m'" if kind == "mesh" else ""}/></body>
            </body><geom type='box' size='1 1 1' contype='0' conaffinity='0'/>"""
        grid = scene(tmp_path, geoms, asset)
        # A ball in C MuJoCo touches the geom where cells are solid, and far from them it does not.
        spec = mujoco.MjSpec.from_file(str(tmp_path / "scene.xml"))
        body = spec.worldbody.add_body()
        body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0], meshname="")
        model = spec.compile()
        data = mujoco.MjData(model)
        middle = (np.argwhere(np.ones(grid.occupied.shape)) + 0.5) * 0.1 + grid.origin
        inside = []
        for point in middle:
            data.qpos[:3] = point
            mujoco.mj_forward(model, data)
            inside.append(data.ncon > 0)
        solid = grid.occupied.reshape(-1)
        assert solid[inside].all() and 0 < sum(inside) < solid.sum() < 6 * sum(inside) + 20, kind


@pytest.mark.parametrize(
    ("geom", "rest", "message"),
    [
        (
            "<geom name='hill' type='hfield' hfield='h'/>",
            "<asset><hfield name='h' nrow='2' ncol='2' size='1 1 1 .1'/></asset>",
            "geom 'hill' is of kind hfield",
        ),
        ("<geom type='ball' size='1'/>", "", "MuJoCo cannot compile it"),
    ],
)
def test_scenes_that_are_refused(tmp_path, geom, rest, message):
    with pytest.raises(ValueError, match=message):
        scene(tmp_path, geom, rest)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"resolution": 0.05}, "unknown arrays resolution; expected occupied, resolution_m"),
        ({"resolution_m": "0.1"}, "resolution_m is of type <U3; expected numbers"),
        ({"resolution_m": [0.1, 0.1]}, "expected one number"),
        ({"origin_m": np.zeros((3, 1))}, r"origin_m has shape \(3, 1\)"),
        ({"origin_m": [0, 0, np.nan]}, "expected x, y and perhaps z"),
        ({"occupied": np.full((4, 4), "solid")}, "occupied is of type <U5"),
        ({"occupied": np.zeros(4)}, r"shape \(4,\)"),
        ({"occupied": np.zeros((4, 4), complex)}, "occupied is of type complex128"),
    ],
)
def test_malformed_npz_maps(tmp_path, arrays, message):
    np.savez(tmp_path / "map.npz", **{"occupied": np.zeros((4, 4), bool), **arrays})
    with pytest.raises(ValueError, match=message):
        load_map(tmp_path / "map.npz")


def test_a_crop_beyond_the_map_is_told(tmp_path):
    nrp_jax.Grid(occupied=np.eye(30, dtype=bool)).save(tmp_path / "map.npz")
    with pytest.warns(UserWarning, match=r"reaches beyond the map; .* spans .* to \[3.0, 2.0\] m"):
        assert load_map(tmp_path / "map.npz", crop=(1, 1, 5, 2)).occupied.shape == (20, 10, 1)
    with warnings.catch_warnings(action="error"):
        load_map(tmp_path / "map.npz", crop=(0, 0, 3, 3))
