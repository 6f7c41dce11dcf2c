"""Metashape's camera exports: lenses, components, chunk transforms, rigs, georeferences, and XML
that means harm."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.captures.sniff import sniff
from pipelines.registry import skipped_stages
from pipelines.sample.align import similarity
from pipelines.sample.scene import pose_matrix
from pipelines.scene.cameras_file import CamerasFile, Intrinsics
from tests.sfm_writers import (
    metashape_pose,
    metashape_transform,
    metashape_xml,
    pictures_of,
    walked,
)
from tests.unit.pipelines.captures.archives import write_zip
from tests.unit.pipelines.captures.ingesting import (
    assert_lenses,
    assert_poses,
    cameras,
    failure,
    ingest,
    sources,
    warning_with,
)

LENSES = (
    Intrinsics(64, 48, 61.5, 60.5, 32.75, 23.5, "OPENCV", -0.03, 0.01, 0.002, 1e-3, 1e-3, -2e-3),
    Intrinsics(48, 64, 30.0, 31.0, 24.5, 31.0, "OPENCV_FISHEYE", 0.02, -0.01, 0.003, 7e-4),
    Intrinsics(64, 48, 55.0, 55.0, 32.0, 24.0),
)
TRUTH = walked(*LENSES)
PICTURES = pictures_of(TRUTH)
TURN = Rotation.from_euler("xyz", [40.0, -70.0, 130.0], degrees=True).as_matrix()
METRES = (TURN, np.array([3.0, -1.0, 0.5]), 0.37)


def of_truth(source: str, truth: CamerasFile = TRUTH) -> np.ndarray:
    (image,) = [image for image in truth.images if image.file == source]
    return pose_matrix(image)[:3]


@pytest.mark.parametrize("name", ["cameras.xml", "export/Chunk 1.XML"])
def test_poses_and_lenses_are_those_that_were_written(tmp_path: Path, name: str) -> None:
    files = PICTURES | {name: metashape_xml(TRUTH).encode()}
    assert sniff(write_zip(tmp_path / "c.zip", files), "c").kind == "metashape"
    summary, ctx = ingest(tmp_path / "job", files)
    assert skipped_stages("metashape") == {"frames"}
    assert (summary["num_posed"], summary["num_sensors"]) == (10, 3)
    assert_poses(ctx, TRUTH)
    assert_lenses(ctx, TRUTH, 1e-12)


@pytest.mark.parametrize("in_component", [True, False])
def test_component_and_chunk_transforms_give_metres(tmp_path: Path, in_component: bool) -> None:
    text = metashape_xml(TRUTH, world=METRES, in_component=in_component)
    summary, ctx = ingest(tmp_path, PICTURES | {"cameras.xml": text.encode()})
    assert (summary["metric"], cameras(ctx).metric) == (True, True)
    assert_poses(ctx, TRUTH)


def test_without_a_transform_nothing_is_metric_and_up_is_found(tmp_path: Path) -> None:
    text = metashape_xml(TRUTH, world=METRES)
    text = re.sub(r"<transform><rotation.*?</transform>", "", text)
    _, ctx = ingest(tmp_path, PICTURES | {"cameras.xml": text.encode()})
    found = np.array([image.world_from_camera for image in cameras(ctx).images])
    true = np.array([of_truth(source) for source in sources(ctx)])
    move = similarity(found[:, :, 3], true[:, :, 3])
    np.testing.assert_allclose(move.apply_to_cameras(found), true, atol=1e-9)
    assert cameras(ctx).metric is False
    assert move.scale == pytest.approx(0.37)
    assert move.rotation[2, 2] > np.cos(np.radians(8.0))


def test_geocentric_coordinates_become_east_north_and_up_in_double_precision(
    tmp_path: Path,
) -> None:
    """Paris: the truth's axes are east, north and up there, 6,366 km from the earth's middle."""
    latitude, longitude = np.radians([48.77, 2.3])
    up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude),
                   np.sin(latitude)])  # fmt: skip
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    axes = np.array([east, np.cross(up, east), up])
    a, b = 6_378_137.0, 6_356_752.314
    radius = a / np.sqrt(1 - (1 - b**2 / a**2) * np.sin(latitude) ** 2)
    place = np.array([radius * up[0], radius * up[1], radius * (b / a) ** 2 * up[2]])
    reference = 'GEOGCS["WGS 84",DATUM["World Geodetic System 1984"]]'
    moved = _moved(TRUTH, axes.T, place)
    text = metashape_xml(moved, world=(np.eye(3), place, 0.5), reference=reference)
    _, ctx = ingest(tmp_path, PICTURES | {"cameras.xml": text.encode()})
    file = cameras(ctx)
    found = np.array([image.world_from_camera for image in file.images])
    true = np.array([of_truth(source) for source in sources(ctx)])
    np.testing.assert_allclose(found[:, :, :3], true[:, :, :3], atol=1e-6)
    centred = true[:, :, 3] - true[:, :, 3].mean(axis=0)
    np.testing.assert_allclose(found[:, :, 3].astype(np.float32), centred, atol=1e-6)
    assert file.metric is True
    back = np.array(file.notes["applied_transform"])
    earth = (found[:, :, 3] - back[:, 3]) @ back[:, :3]
    np.testing.assert_allclose(earth, true[:, :, 3] @ axes + place, atol=1e-6)


def _moved(truth: CamerasFile, rotation: np.ndarray, shift: np.ndarray) -> CamerasFile:
    images = []
    for image in truth.images:
        pose = rotation @ pose_matrix(image)[:3]
        pose[:, 3] += shift
        images.append(replace(image, world_from_camera=tuple(map(tuple, pose.tolist()))))
    return replace(truth, images=tuple(images))


def test_a_rigs_other_cameras_hang_on_their_master(tmp_path: Path) -> None:
    """Picture 9 is taken by the second camera of a rig, a turned one beside the first."""
    turn = Rotation.from_euler("xyz", [5.0, 20.0, -3.0], degrees=True).as_matrix()
    offset = np.array([0.2, -0.05, 0.1])
    text = metashape_xml(TRUTH, world=METRES)
    held = np.vstack([np.column_stack([turn, offset / METRES[2]]), [0, 0, 0, 1.0]])
    master = metashape_pose(pose_matrix(TRUTH.images[8])[:3])
    scaled = held.copy()
    scaled[:3, 3] = offset
    true = ((master @ scaled) * [1.0, -1.0, -1.0, 1.0])[:3]
    rig = "".join(
        f"<{tag}>{' '.join(map(repr, np.ravel(values).tolist()))}</{tag}>"
        for tag, values in (("rotation", held[:3, :3]), ("location", held[:3, 3]))
    )
    text = re.sub(r'<camera id="9" .*?</camera>', '<camera id="9" sensor_id="7" master_id="8" '
                  'label="IMG_18"/>', text)  # fmt: skip
    sensor = re.search(r'<sensor id="2".*?</sensor>', text)
    assert sensor is not None
    second = (
        sensor[0].replace('id="2"', 'id="7" master_id="2"').replace("</sensor>", rig + "</sensor>")
    )
    text = text.replace("</sensors>", second + "</sensors>")
    pictures = PICTURES | {TRUTH.images[9].file: PICTURES[TRUTH.images[8].file]}
    _, ctx = ingest(tmp_path, pictures | {"cameras.xml": text.encode()})
    index = sources(ctx).index(TRUTH.images[9].file)
    np.testing.assert_allclose(cameras(ctx).images[index].world_from_camera, true, atol=1e-9)
    for image, source in zip(cameras(ctx).images, sources(ctx), strict=True):
        if source != TRUTH.images[9].file:
            np.testing.assert_allclose(image.world_from_camera, of_truth(source), atol=1e-9)


def test_components_without_a_place_are_not_mixed(tmp_path: Path) -> None:
    """Each has a world of its own: those of the largest are taken, and the others told."""
    text = metashape_xml(TRUTH, in_component=True)
    for n in (0, 1):
        text = text.replace(f'<camera id="{n}" sensor_id="{n}" component_id="0"',
                            f'<camera id="{n}" sensor_id="{n}" component_id="1"')  # fmt: skip
    text = text.replace("</components>", '<component id="1"/></components>')
    summary, ctx = ingest(tmp_path, PICTURES | {"cameras.xml": text.encode()})
    assert len(cameras(ctx).images) == 8
    assert "IMG_10, IMG_9" in warning_with(summary, "2 cameras lie in components of their own")


def test_components_that_have_a_place_share_one_world(tmp_path: Path) -> None:
    text = metashape_xml(TRUTH, world=METRES, in_component=True)
    other = Rotation.from_euler("z", 50.0, degrees=True).as_matrix()
    place, scale = np.array([9.0, 9.0, 9.0]), 2.0
    for n in (0, 1):
        pose = metashape_pose(pose_matrix(TRUTH.images[n])[:3])
        pose[:3, :3] = other.T @ pose[:3, :3]
        pose[:3, 3] = other.T @ (pose[:3, 3] - place) / scale
        numbers = " ".join(map(repr, np.ravel(pose).tolist()))
        text = re.sub(
            rf'(<camera id="{n}" sensor_id="{n}" component_id=)"0"(.*?<transform>).*?</transform>',
            rf'\1"1"\g<2>{numbers}</transform>',
            text,
        )
    second = f'<component id="1">{metashape_transform(other, place, scale)}</component>'
    text = text.replace("</components>", second + "</components>")
    _, ctx = ingest(tmp_path, PICTURES | {"cameras.xml": text.encode()})
    assert len(cameras(ctx).images) == 10
    assert_poses(ctx, TRUTH)


def test_cameras_that_are_off_or_not_aligned_are_told(tmp_path: Path) -> None:
    text = metashape_xml(TRUTH, extra='<camera id="90" sensor_id="0" label="IMG_90"/>')
    text = text.replace('<camera id="3"', '<camera enabled="false" id="3"')
    summary, ctx = ingest(tmp_path, PICTURES | {"cameras.xml": text.encode()})
    assert len(cameras(ctx).images) == 9
    assert "IMG_90" in warning_with(summary, "1 cameras in cameras.xml are not aligned")
    assert "IMG_12" in warning_with(summary, "1 cameras in cameras.xml are switched off")


def test_equal_labels_are_told_apart_by_their_groups(tmp_path: Path) -> None:
    truth = walked(LENSES[2])
    labels = [f"IMG_{index % 5}" for index in range(10)]
    text = metashape_xml(truth, labels=labels)
    inner = re.findall(r"<camera .*?</camera>", text)
    groups = "".join(
        f'<group id="{n}" label="day{n}" type="folder">{"".join(inner[5 * n : 5 * n + 5])}</group>'
        for n in (0, 1)
    )
    text = re.sub(r"<cameras>.*</cameras>", f"<cameras>{groups}</cameras>", text)
    pictures = pictures_of(truth)
    named = {f"day{n // 5}/{labels[n]}.jpg": pictures[truth.images[n].file] for n in range(10)}
    _, ctx = ingest(tmp_path, {**named, "cameras.xml": text})
    by_name = {name: pose_matrix(truth.images[n])[:3] for n, name in enumerate(named)}
    assert len(cameras(ctx).images) == 10
    for image, source in zip(cameras(ctx).images, sources(ctx), strict=True):
        np.testing.assert_allclose(image.world_from_camera, by_name[source], atol=1e-9)


def test_a_skew_is_told_in_pixels(tmp_path: Path) -> None:
    text = metashape_xml(TRUTH).replace("</calibration>", "<b2>-4.0</b2></calibration>")
    summary, _ = ingest(tmp_path, PICTURES | {"cameras.xml": text.encode()})
    assert "up to 4.1 px" in warning_with(summary, "3 of 3 lenses", "b2")


def test_uncalibrated_sensors_are_taken_at_their_word_and_told(tmp_path: Path) -> None:
    truth = walked(LENSES[2])
    pictures = pictures_of(truth)
    text = re.sub(r"<calibration.*</calibration>", "", metashape_xml(truth))
    summary, ctx = ingest(tmp_path / "a", pictures | {"cameras.xml": text.encode()})
    (lens,) = cameras(ctx).cameras
    assert (lens.model, lens.fl_x, lens.cx) == ("PINHOLE", pytest.approx(60.0), 32.0)
    assert "lens 0" in warning_with(summary, "1 of 1 sensors were not calibrated")
    text = re.sub(r"<property.*?/>", "", text)
    error = failure(tmp_path / "b", pictures | {"cameras.xml": text.encode()})
    assert "neither a calibration nor a focal length" in error.message


def test_the_adjusted_calibration_comes_before_the_initial_one(tmp_path: Path) -> None:
    summary, ctx = ingest(tmp_path, PICTURES | {"cameras.xml": metashape_xml(TRUTH).encode()})
    assert all(lens.fl_x > 20 for lens in cameras(ctx).cameras)
    assert not any("calibrated" in text for text in summary["warnings"])


def test_without_pictures_it_says_which_it_wants(tmp_path: Path) -> None:
    error = failure(tmp_path, {"cameras.xml": metashape_xml(TRUTH)})
    assert (error.code, "IMG_10" in error.message) == ("poses_missing", True)
    assert "Pack the pictures" in error.hint


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("notes.xml", "<?xml version='1.0'?><document><p>Holiday</p></document>"),
        ("layout.xml", '<?xml version="1.0"?><root version="1.0"/>'),
        ("scan.psx", '<?xml version="1.0"?><document version="1.2.0" path="x"/>'),
    ],
)
def test_other_xml_is_none(tmp_path: Path, name: str, text: str) -> None:
    assert sniff(write_zip(tmp_path / "c", PICTURES | {name: text.encode()}), "c").kind == "images"


HEAD = '<?xml version="1.0"?>\n<document version="1.5.0">'
DOCTYPE = "<!DOCTYPE document [{}]>"


def bomb(declared: str, used: str) -> str:
    text = metashape_xml(TRUTH)
    text = text.replace('label="Chunk 1"', f'label="{used}"')
    return text.replace("<document", DOCTYPE.format(declared) + "<document", 1)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (bomb('<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">', "&b;"), "document type"),
        (bomb('<!ENTITY a SYSTEM "file:///etc/passwd">', "&a;"), "document type"),
        (bomb('<!ENTITY a SYSTEM "http://127.0.0.1:9/x">', "&a;"), "document type"),
        (bomb('<!ENTITY % p SYSTEM "file:///etc/passwd"> %p;', ""), "document type"),
        (metashape_xml(TRUTH).replace("Chunk 1", "&a;"), "no readable XML"),
        (HEAD + "<chunk>" + "<a>" * 100, "too deep"),
        (HEAD + "<chunk>", "no readable XML"),
        (HEAD + "<chunk/></document>", "has no cameras"),
        (HEAD + "<chunk><cameras/></chunk></document>", "none is both aligned and on"),
        (metashape_xml(TRUTH)[:-900], "no readable XML"),
        (metashape_xml(TRUTH).replace("UTF-8", "KLINGON"), "no readable XML"),
        (metashape_xml(TRUTH).replace('type="f', 'type="spherical f'), "spherical"),
        (metashape_xml(TRUTH).replace('sensor_id="', 'sensor_id="9'), "which is not there"),
        (metashape_xml(TRUTH, world=(np.eye(3), np.zeros(3), -2.0)), "scale"),
        (re.sub(r"<f>[^<]*</f>", "<f>nan</f>", metashape_xml(TRUTH)), "finite numbers"),
        (re.sub(r"<f>[^<]*</f>", "", metashape_xml(TRUTH)), "no focal length f"),
        (re.sub(r'width="\d+"', 'width="x"', metashape_xml(TRUTH)), "resolution"),
        (re.sub(r'width="\d+"', f'width="{"9" * 400}"', metashape_xml(TRUTH)), "resolution"),
        (re.sub(r"<f>[^<]*</f>", "<f>1e-80</f><p3>1</p3>", metashape_xml(TRUTH)), "focal length f"),
        (re.sub(r"<f>[^<]*</f>", "<f>1e80</f>", metashape_xml(TRUTH)), "focal length f"),
        (re.sub(r"<transform>\S+ ", "<transform>inf ", metashape_xml(TRUTH)), "16 finite numbers"),
        (re.sub(r"<transform>\S+ ", "<transform>9.0 ", metashape_xml(TRUTH)), "no rotation"),
        (re.sub(r"<transform>\S+ ", "<transform>", metashape_xml(TRUTH)), "16 finite numbers"),
    ],
)  # fmt: skip
def test_harm_and_faults_are_refused_by_name(tmp_path: Path, text: str, words: str) -> None:
    error = failure(tmp_path, PICTURES | {"cameras.xml": text.encode()})
    assert error.code in ("poses_malformed", "poses_missing")
    assert words in error.message
    assert "root:" not in error.message


def test_one_bad_camera_in_ten_is_left_out_by_name(tmp_path: Path) -> None:
    text = re.sub(r"<transform>\S+ ", "<transform>nan ", metashape_xml(TRUTH), count=1)
    summary, ctx = ingest(tmp_path, PICTURES | {"cameras.xml": text.encode()})
    assert len(cameras(ctx).images) == 9
    assert "IMG_9.jpg" in warning_with(summary, "Left out")


def test_photos_that_were_developed_since_are_found_and_told(tmp_path: Path) -> None:
    """Aligned as raw files, sent as JPEG; one label fits two pictures, and is left out."""
    labels = [f"{image.file.rpartition('/')[2][:-4]}.CR2" for image in TRUTH.images]
    files = PICTURES | {"cameras.xml": metashape_xml(TRUTH, labels=labels).encode()}
    summary, ctx = ingest(tmp_path / "a", files)
    assert_poses(ctx, TRUTH)
    assert "IMG_10.CR2" in warning_with(summary, "10 paths", "matched by the end of the name")
    labels[1] = "IMG_9.TIF"
    files = PICTURES | {"cameras.xml": metashape_xml(TRUTH, labels=labels).encode()}
    summary, ctx = ingest(tmp_path / "b", files)
    assert len(cameras(ctx).images) == 8
    assert_poses(ctx, TRUTH)
    assert warning_with(summary, "2 of them are not in the archive", "IMG_9.CR2, IMG_9.TIF")
