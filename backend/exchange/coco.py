"""COCO JSON: contact patch and outlines on scene pictures, markers on tactile pictures."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.backend import core, episodes
from touchdown.backend.annotations import Dataset, Label, Pair, content_hash, patch_iou
from touchdown.backend.exchange.exports import ExportJob
from touchdown.backend.exchange.label_import import ImportedLabel, label_file
from touchdown.backend.exchange.query import SelectedEpisode
from touchdown.backend.geometry import overlap_polygon, rings_of, rotated
from touchdown.backend.sensing import Homography

FILE = "annotations.json"
PX_PER_MM = 20.0
MARGIN_MM = 12.0
VISIBLE = 2
DECIMALS = 4
CONTACT, FACE, BOTTOM, GEL = 1, 2, 3, 4  # categories
PICTURES = "images"
Annotations = list[dict[str, object]]
MIN_IOU = 0.99
INK, PAPER = 60, 245


def write(job: ExportJob, folder: Path) -> Mapping[str, object]:
    """Write ``annotations.json`` and the pictures of every episode into ``folder``.

    Scene picture while pressed: patch, face and bottom by its homography. Tactile pictures at the
    last tick: the 63 markers. An episode without a scene picture has a drawing of its bottom.
    """
    (folder / PICTURES).mkdir()
    images: list[dict[str, object]] = []
    annotations: list[dict[str, object]] = []

    def add(one: SelectedEpisode, name: str, size: tuple[int, int], found: Annotations,
            **extra: object) -> None:  # fmt: skip
        images.append({
            "id": len(images) + 1, "file_name": f"{PICTURES}/{name}", "width": size[0],
            "height": size[1], "episode": one.entry.uuid, "file_sha256": one.entry.sha256,
            "pair": one.revision.geometry, "split": one.split, **extra,
        })  # fmt: skip
        for annotation in found:
            numbers = {"id": len(annotations) + 1, "image_id": len(images), "iscrowd": 0}
            annotations.append({**numbers, **annotation})

    for one in job.chosen:
        pair = job.dataset.geometry.pair(one.revision.geometry)
        path = job.dataset.folder / one.entry.path
        is_packed = one.entry.mode == "mass"
        contents = episodes.ChunkContents() if is_packed else episodes.read_whole(path)
        canvas, picture = _scene(contents) or (drawn_canvas(pair), None)
        name = f"{one.revision.geometry[:16] if picture is None else one.entry.uuid}-scene.png"
        if not (folder / PICTURES / name).exists():
            canvas.save(folder / PICTURES / name, pair, picture)
        matrix = canvas.board.matrix.tolist()
        add(one, name, canvas.size, _annotations(one, pair, canvas), homography=matrix)
        for finger, (suffix, encoded, markers) in _tactile(contents).items():
            name = f"{one.entry.uuid}-{finger}.{suffix}"
            (folder / PICTURES / name).write_bytes(encoded)
            add(one, name, episodes.TACTILE_PX, [markers])
        job.advance(one.index + 1)
    selected = content_hash([[o.entry.uuid, o.revision.rev_uuid] for o in job.chosen])
    info = {"description": "contact patches", "revisions_sha256": selected}
    categories = [
        {"id": CONTACT, "name": "contact", "supercategory": "patch",
         "keypoints": ["offset", "com"], "skeleton": []},
        {"id": FACE, "name": "face", "supercategory": "outline"},
        {"id": BOTTOM, "name": "bottom", "supercategory": "outline"},
        {"id": GEL, "name": "gel", "supercategory": "sensor", "skeleton": [],
         "keypoints": [f"marker{k:02d}" for k in range(core.MARKERS)]},
    ]  # fmt: skip
    content = {"info": info, "images": images, "annotations": annotations, "categories": categories}
    (folder / FILE).write_text(json.dumps(content, ensure_ascii=False), "utf-8")
    return {"data": "json"}


@dataclass(frozen=True, slots=True)
class Canvas:
    """Picture of ``size`` (width, height); ``board`` maps mm in the frame of the bottom to px."""

    board: Homography
    size: tuple[int, int]

    def px(self, points_mm: core.FloatArray) -> core.FloatArray:
        """Return points (n, 2) of the bottom frame in px."""
        return np.asarray(np.round(self.board.to_px(points_mm), DECIMALS), dtype=np.float64)

    def save(self, path: Path, pair: Pair, picture: core.ImageArray | None) -> None:
        """Write ``picture``, or a drawing of the outline of the bottom."""
        if picture is None:
            picture = np.full(self.size[::-1], PAPER, dtype=np.uint8)
            rings = rings_of(self.px(pair.bottom.path()))
            corners = [np.rint(ring).astype(np.int32) for ring in rings]
            cv2.polylines(picture, corners, isClosed=True, color=INK, thickness=2)
        done, data = cv2.imencode(".png", picture)
        assert done
        path.write_bytes(data.tobytes())


def drawn_canvas(pair: Pair) -> Canvas:
    """Return the canvas of a drawing of the bottom, ``PX_PER_MM`` to scale."""
    x, y = (math.ceil((mm + MARGIN_MM) * PX_PER_MM) for mm in pair.bottom.half_extents_mm)
    return Canvas(_drawn(PX_PER_MM, (x, y)), (2 * x + 1, 2 * y + 1))


def _drawn(px_per_mm: float, origin_px: Sequence[float]) -> Homography:
    """Return the map of a drawing, whose rows run downwards."""
    matrix = np.diag([px_per_mm, -px_per_mm, 1.0])
    matrix[:2, 2] = origin_px
    return Homography(matrix, 0.0)


def _scene(contents: episodes.ChunkContents) -> tuple[Canvas, core.ImageArray] | None:
    """Return canvas and picture of the scene camera while pressed, None without them."""
    messages = contents.messages.get(episodes.SCENE_TOPIC.name)
    pairs = dict(core.parse_json(contents.metadata["pairs"]["items"])) if messages else {}
    if not messages or episodes.HOMOGRAPHY_KEY not in pairs:
        return None
    picture = episodes.decode_image(episodes.unpack_image(messages[0])[1])
    size = (picture.shape[1], picture.shape[0])
    return Canvas(Homography.parse(pairs[episodes.HOMOGRAPHY_KEY]), size), picture


def _tactile(
    contents: episodes.ChunkContents,
) -> dict[core.Finger, tuple[str, bytes, dict[str, object]]]:
    """Return the encoded picture of each finger nearest to the last tick, and its markers."""
    found: dict[core.Finger, tuple[str, bytes, dict[str, object]]] = {}
    for finger in core.FINGERS:
        images = contents.messages.get(episodes.IMAGE_TOPICS[finger].name)
        fields = contents.messages.get(episodes.MARKER_TOPICS[finger].name)
        if images and fields:
            last_ns = episodes.stamps_ns(contents.messages[episodes.OBSERVATION_TOPIC.name])[-1]
            image = images[int(np.abs(episodes.stamps_ns(images) - last_ns).argmin())]
            at = int(np.abs(episodes.stamps_ns(fields) - episodes.stamps_ns([image])).argmin())
            markers = episodes.unpack_markers(fields[at : at + 1])
            # Seen, inferred and lost are visible, not visible and not labelled.
            visible = VISIBLE - markers.state[0].astype(int)
            points = np.column_stack([markers.position_px[0].round(DECIMALS), visible])
            points[visible == 0] = 0.0
            box = [0.0, 0.0, *map(float, episodes.TACTILE_PX)]
            found[finger] = *episodes.unpack_image(image), {
                "category_id": GEL, "bbox": box, "area": box[2] * box[3], "segmentation": [],
                "keypoints": points.ravel().tolist(), "num_keypoints": int((visible > 0).sum()),
            }  # fmt: skip
    return found


def _annotations(one: SelectedEpisode, pair: Pair, canvas: Canvas) -> Annotations:
    revision = one.revision
    offset = revision.label.offset_mm
    yaw_rad = math.radians((revision.label.theta_mdeg or 0) / 1e3)
    x_mm, y_mm = offset.tolist()
    patch_mm = overlap_polygon(pair.face, (x_mm, y_mm), pair.bottom, yaw_rad)
    centre_mm = offset + rotated(np.array(pair.centre_mm), yaw_rad)
    points = [
        value
        for xy in canvas.px(np.stack([offset, centre_mm])).tolist()
        for value in (*xy, VISIBLE)
    ]
    face_mm = rotated(pair.face.path(), yaw_rad) + offset
    outlines = ((CONTACT, patch_mm), (FACE, face_mm), (BOTTOM, pair.bottom.path()))
    found: Annotations = [
        {"category_id": kind, **_shape(rings_of(canvas.px(outline)), canvas.size[::-1])}
        for kind, outline in outlines
    ]
    found[0] |= {
        "keypoints": points, "num_keypoints": 2, "rev_uuid": revision.rev_uuid,
        "source": revision.source, "state": revision.state, "label": asdict(revision.label),
    }  # fmt: skip
    return found


def _shape(rings_px: list[core.FloatArray], size: tuple[int, int]) -> dict[str, object]:
    """Return segmentation, box and area of the rings.

    The format has no holes in polygons: a patch with holes is run-length encoded.
    """
    if not rings_px:
        return {"segmentation": [], "bbox": [0, 0, 0, 0], "area": 0.0}
    every = np.concatenate(rings_px)
    low, high = every.min(axis=0), every.max(axis=0)
    areas = [float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) for x, y in (r.T for r in rings_px)]
    holed = min(areas) * max(areas) < 0.0
    segmentation: object = [ring.reshape(-1).tolist() for ring in rings_px]
    if holed:
        segmentation = {"size": list(size), "counts": _runs(rings_px, size)}
    return {
        "segmentation": segmentation,
        "bbox": np.round([*low, *(high - low)], DECIMALS).tolist(),
        "area": round(0.5 * abs(sum(areas)), DECIMALS),
    }


def _runs(rings_px: list[core.FloatArray], size: tuple[int, int]) -> list[int]:
    """Return the run lengths, column by column, of the pixels whose centres are inside.

    The first run is outside. Inside is by the odd-even rule.
    """
    crossed = np.zeros((size[1], size[0]), dtype=np.bool_)
    for ring in rings_px:
        for (x0, y0), (x1, y1) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            columns = np.arange(math.ceil(min(x0, x1)), math.ceil(max(x0, x1)))
            rows = np.ceil(y0 + (columns - x0) * (y1 - y0) / ((x1 - x0) or 1.0)).astype(np.intp)
            crossed[columns, rows] ^= True
    inside = np.logical_xor.accumulate(crossed, axis=1).reshape(-1)
    ends = np.flatnonzero(np.diff(inside, prepend=False)).tolist()
    return [int(run) for run in np.diff([0, *ends, inside.size])]


def read_coco(source: Path, dataset: Dataset) -> Iterator[ImportedLabel]:
    """Yield the offsets of ``annotations.json``; rows whose polygon does not fit carry a warning.

    Raises ``InputError`` if the file is damaged or foreign.
    """
    path = label_file(source, FILE)
    try:
        content = core.parse_json(path.read_bytes())
        info, images = content["info"], {image["id"]: image for image in content["images"]}
        for annotation in content["annotations"]:
            if annotation["category_id"] != CONTACT:
                continue
            image = images[annotation["image_id"]]
            if "homography" in image:
                board = Homography(np.array(image["homography"], np.float64).reshape(3, 3), 0.0)
            else:  # exports of earlier versions
                board = _drawn(float(info["px_per_mm"]), info["origin_px"][image["pair"]])
            yield _row(annotation, image, board, dataset)
    except (OSError, ValueError, KeyError, TypeError, IndexError, cv2.error) as error:
        why = f"{error} is missing" if isinstance(error, KeyError) else error
        fix = "Export them again."
        raise core.InputError(f"The annotations cannot be read: {why}.", str(path), fix) from error


def _row(
    annotation: Mapping[str, Any], image: Mapping[str, Any], board: Homography, dataset: Dataset
) -> ImportedLabel:
    """Return one offset; ``board`` maps mm of the bottom frame to px."""
    at_px = np.array(annotation["keypoints"][:2], dtype=np.float64)
    inverse = Homography(np.asarray(np.linalg.inv(board.matrix), np.float64), 0.0)
    ((x_mm, y_mm),) = inverse.to_px(at_px).tolist()
    x_um, y_um = round(x_mm * 1e3), round(y_mm * 1e3)
    was = Label(**annotation["label"]) if "label" in annotation else None
    moved = was is None or (was.x_um, was.y_um) != (x_um, y_um)
    theta_mdeg = None if was is None else was.theta_mdeg
    # the uncertainty of a moved label is unknown
    label = Label(x_um, y_um, theta_mdeg, None if moved or was is None else was.sigma_um)
    warning = ""
    if annotation["segmentation"]:
        pair = dataset.geometry.pair(str(image["pair"]))
        points = rotated(pair.points_mm, math.radians((label.theta_mdeg or 0) / 1e3))
        points_px = board.to_px(points + label.offset_mm)
        touching = dataset.geometry.patch(pair.sha256, label).touching
        share = _iou(annotation["segmentation"], points_px, touching)
        if share < MIN_IOU:
            warning = f"its polygon and the patch of its offset overlap by {share:.2f} only"
    return ImportedLabel(str(image["episode"]), str(image.get("file_sha256", "")), label, warning)


def _iou(segmentation: Any, points_px: core.FloatArray, touching: NDArray[np.bool_]) -> float:
    """Return the overlap of the points (n, 2) within a drawn patch with the derived one (n,).

    Rounding of the corners moves the edge by up to a pixel, so points near it are not compared.
    """
    if isinstance(segmentation, Mapping):
        height, width = (int(n) for n in segmentation["size"])
        counts = np.array(segmentation["counts"], dtype=np.intp)
        flat = np.repeat(np.arange(len(counts)) % 2, counts).astype(np.uint8)
        mask: NDArray[Any] = flat.reshape(width, height).T
    else:
        low = np.floor(points_px.min(axis=0))
        points_px = points_px - low
        width, height = points_px.max(axis=0).astype(int) + 2
        rings = [np.rint(np.reshape(ring, (-1, 2)) - low).astype(np.int32) for ring in segmentation]
        mask = cv2.fillPoly(np.zeros((height, width), np.uint8), rings, (1,))
    mask = np.pad(mask, 2)
    x, y = np.clip(np.rint(points_px).astype(np.intp), -1, [width, height]).T + 2
    around = np.stack([mask[y + j, x + i] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    near = (around != around[4]).any(axis=0)
    drawn = np.where(near, touching, around[4] == 1)
    return patch_iou(drawn, touching)
