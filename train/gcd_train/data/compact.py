"""Repacks downloaded scenes into the compact layout: a twentieth of the bytes to read, every picture compared."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from gcd_train.data import encodings, kubric4d, parallel_domain4d
from gcd_train.data.dataset4d import layout_in, scene_names
from gcd_train.data.encodings import FAR_M, NEAR_M
from gcd_train.data.files import GEOMETRY, MANIFEST, FileFault, SceneFiles, read_manifest
from gcd_train.data.kubric4d import Kubric4D
from gcd_train.data.parallel_domain4d import ParallelDomain4D
from gcd_train.data.sample import SceneView
from gcd_train.errors import DataError, RecipeError
from gcd_train.files import new_folder

_LEAST_PSNR_DB = 20.0  # what WebP of this quality is far above
_JSON_FOLDERS = ("calibration", "ontology")


@dataclass(frozen=True, kw_only=True, slots=True)
class Packed:
    """made: False for a scene that was there already. written: bytes. gaps: views that the source lacks."""

    made: bool
    written: int = 0
    gaps: int = 0


@dataclass(frozen=True, kw_only=True, slots=True)
class Compaction:
    """Packs one scene at a time, in any process.

    source, out: folders of scenes. orbits: whether in Kubric-4D's layout, else in ParallelDomain-4D's. cameras: that a
    scene must have. gaps: a picture may be missing, as some of ParallelDomain-4D are.
    """

    source: Path
    out: Path
    orbits: bool
    cameras: tuple[str, ...]
    gaps: bool = False

    @classmethod
    def of(cls, source: Path, out: Path, *, cameras: tuple[str, ...] = (), gaps: bool = False) -> "Compaction":
        """cameras: empty for the published ones. Raises DataError: there are no scenes. RecipeError: one folder."""
        source, out = source.resolve(), out.resolve()
        if source == out:
            raise RecipeError(f"{source} cannot be packed into itself; give another OUT")
        orbits = layout_in(source) == "kubric4d"
        usual = kubric4d.CAMERAS if orbits else parallel_domain4d.CAMERAS
        return cls(source=source, out=out, orbits=orbits, cameras=cameras or usual, gaps=gaps)

    @property
    def scenes(self) -> tuple[str, ...]:
        """All there are, by number. Raises DataError for none."""
        return tuple(scene_names(self.source, "kubric4d" if self.orbits else "parallel_domain4d"))

    def __call__(self, scene: str) -> Packed:
        """Pack a scene unless it is there: its folder appears once everything in it was compared with the source.

        Raises: DataError: files are missing or damaged, how many and which first. OSError: nothing can be written.
        """
        if (self.out / scene).exists():
            return Packed(made=False)
        reader = self._reader(self.source, scene)
        frames = reader.frames(scene)
        with new_folder(self.out, scene) as folder:
            files = SceneFiles(folder)
            for path in self._facts(scene):
                files.write(folder / path.relative_to(self.source / scene), path.read_bytes())
            written = self._write_views(reader, scene, files)
            packed = self._reader(folder.parent, scene)
            for time, camera in written:
                same, view = packed.view(scene, camera, time), reader.view(scene, camera, time)
                _require_alike(same, view, f"{camera} at frame {time}", street=not self.orbits)
            if (self.source / scene / MANIFEST).exists():  # a scene of ours, whose files are others now
                told = read_manifest(self.source / scene)
                told = msgspec.structs.replace(told, compact=True, files=dict(sorted(files.checksums.items())))
                files.write(folder / MANIFEST, msgspec.json.format(msgspec.json.encode(told), indent=1))
        gaps = frames * len(self.cameras) - len(written)
        return Packed(made=True, written=files.size, gaps=gaps)

    def _reader(self, root: Path, scene: str) -> Kubric4D | ParallelDomain4D:
        if self.orbits:
            return Kubric4D(root, [scene], cameras=self.cameras, instances=True)
        forward = parallel_domain4d.FORWARD  # it tells how many frames there are, or the first one does
        ahead = forward if forward in self.cameras else self.cameras[0]
        return ParallelDomain4D(root, [scene], cameras=self.cameras, source_camera=ahead, instances=True)

    def _facts(self, scene: str) -> Iterator[Path]:
        """Files of a scene that are no pictures."""
        folder = self.source / scene
        if self.orbits:
            yield from (kubric4d.metadata_path(folder, camera) for camera in self.cameras)
        yield from (path for name in _JSON_FOLDERS for path in sorted((folder / name).glob("*.json")))
        if (folder / MANIFEST).exists():
            yield folder / GEOMETRY

    def _write_views(self, reader: Kubric4D | ParallelDomain4D, scene: str, files: SceneFiles) -> list[tuple[int, str]]:
        """Time and camera of all that were written. Raises DataError."""
        written, faults = list[tuple[int, str]](), list[FileFault]()
        for time, camera in product(range(reader.frames(scene)), self.cameras):
            try:
                view = reader.view(scene, camera, time)
            except FileFault as fault:
                if fault.path.exists() or not self.gaps:
                    faults.append(fault)
                continue
            if not faults:
                for path, data in self._encoded(self.source / scene, files.folder, view, time, camera):
                    files.write(path, data)
                written.append((time, camera))
        if faults:
            missing = sum(not fault.path.exists() for fault in faults)
            advice = "download them again, or give --gaps" if missing == len(faults) else "download them again"
            raise DataError(
                f"{missing} views lack a file and {len(faults) - missing} are damaged; {advice}. First: {faults[0]}"
            )
        return written

    def _encoded(
        self, source: Path, out: Path, view: SceneView, time: int, camera: str
    ) -> Iterator[tuple[Path, bytes]]:
        """Where the pictures of a view go, and what is in them. source, out: folders of the scene."""
        names: Any = kubric4d if self.orbits else parallel_domain4d
        colour, ids = ("rgba", "segmentation") if self.orbits else ("rgb", "instance_segmentation_2d")
        depth = encodings.depth_png if self.orbits else encodings.street_depth_png

        def place(folder: Path, layer: str, *, compact: bool = True) -> Path:
            return names.frame_path(folder, camera, layer, time, compact=compact)

        if not place(source, colour, compact=False).exists():
            raise DataError(f"{place(source, colour, compact=False)} is not there: the scene is compact already")
        yield place(out, colour), encodings.webp(view.rgb, quality=names.WEBP_QUALITY)
        yield place(out, "depth"), depth(view.depth)
        if view.classes is not None:
            yield place(out, "semantic_segmentation_2d"), encodings.packed_id_png(view.classes)
        if view.instances is not None:
            small = not self.orbits and int(view.instances.max()) < 256
            packed = encodings.packed_id_png(view.instances.astype(np.uint8)) if small else b""
            yield place(out, ids), packed or place(source, ids).read_bytes()


def _require_alike(packed: SceneView, view: SceneView, place: str, *, street: bool) -> None:
    """Raises DataError unless a packed view tells what its source told."""
    faults: list[str] = []
    error = float(np.mean((packed.rgb.astype(np.float32) - view.rgb) ** 2))
    if error > 255**2 * 10 ** (-_LEAST_PSNR_DB / 10):
        faults.append("its colours")
    depth = np.where(view.depth > 0, view.depth.clip(NEAR_M, FAR_M), 0)
    off = 0.0013 * (1 + depth / 20) if street else np.float32(0.0006)
    if not (np.abs(packed.depth - depth) <= off * depth).all():
        faults.append("its depth")
    for name in ("classes", "instances"):
        one, other = getattr(packed, name), getattr(view, name)
        if (one is None) != (other is None) or (one is not None and not np.array_equal(one, other)):
            faults.append(f"its {name}")
    if not np.array_equal(packed.world_from_camera, view.world_from_camera) or packed.lens != view.lens:
        faults.append("its camera")
    if faults:
        raise DataError(
            f"{place}: {', '.join(faults)} came out of the packing otherwise; the disk or this machine is at fault"
        )
