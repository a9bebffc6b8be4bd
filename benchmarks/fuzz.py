"""Files that lie: mutated checkpoints, datasets, curves, run records and TOML.

    python benchmarks/fuzz.py --cases 100000 --seed 0

Each case damages a valid small file: bytes are flipped, cut, inserted or moved, or values of its
JSON are replaced, removed or added and its sha256 is made to fit again, so that what lies behind
the digest is reached. Whatever comes out must be a result or an error for people
(``HjepaError``), soon, without taking more than twice the file's size in memory. Prints cases
per second and outcomes by kind; the first violation ends it with the seed that repeats it.
"""

import argparse
import collections
import copy
import hashlib
import io
import json
import random
import shutil
import struct
import sys
import tempfile
import time
import tracemalloc
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hjepa_cli.config.checks import check_settings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.datasets import dataset as datasets
from hjepa_cli.core.evaluation import curves
from hjepa_cli.core.networks.model import Model, build_modules, tensors_of
from hjepa_cli.core.radio.cell import Cell
from hjepa_cli.core.radio.laws.duty import DUTY
from hjepa_cli.core.radio.laws.equal import EQUAL
from hjepa_cli.core.radio.laws.requirement import LinkRequirement
from hjepa_cli.core.training import progress
from hjepa_cli.core.training.optimiser import Optimiser
from hjepa_cli.errors import HjepaError, Unsealed
from hjepa_cli.output import tables
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import compare, data, models, report, results, resume
from hjepa_cli.storage import files, runs, seals, shards, tensors, zoo
from hjepa_cli.storage.checkpoints import load_checkpoint, save_checkpoint

SLOWEST_S = 5.0
OVERHEAD_BYTES = 4_000_000  # of the reader itself: parsed JSON, messages
QUIET = Screen(quiet=True, stdout=io.StringIO(), stderr=io.StringIO())
NASTY = [
    None, True, False, 0, 1, -1, 2, 3.5, 1e308, -1e308, 10**30, 2**63, "", "x", "../../x",
    "\x1b[31m", "[/red]", "desktop", "hierarchy", "NaN", [], [1], [[]], {}, {"a": 1}, "0" * 64,
]  # fmt: skip
ARCHITECTURE = {
    "kind": "hierarchy", "embedding": 8, "hidden": 8, "frame_input": "difference", "centre": True,
    "stride_actions": "all", "residual": True, "mirror": "exact", "h": 4, "m": 2, "l": 1,
    "actor_hidden": 8, "actor_dropout": 0.1,
}  # fmt: skip
METADATA = {
    "stage": "train-hierarchy",
    "plant": "desktop",
    "architecture": ARCHITECTURE,
    "settings": {"encoder": {"precision": "fp32"}},
    "health": {"std": 1.0},
    "seed": 0,
    "versions": {"torch": "2"},
}
DIGEST = curves.Digest("0" * 64, "1" * 64)


def mutate_bytes(data: bytes, chance: random.Random) -> bytes:
    """Damage anywhere, with a preference for the beginning, where headers are."""
    damaged = bytearray(data)
    for _ in range(chance.choice((1, 1, 2, 5))):
        end = len(damaged) if chance.random() < 0.5 else min(len(damaged), 600)
        at = chance.randrange(max(end, 1))
        kind = chance.randrange(5)
        if kind == 0 and damaged:
            damaged[min(at, len(damaged) - 1)] ^= 1 << chance.randrange(8)
        elif kind == 1:
            del damaged[at:]
        elif kind == 2:
            damaged[at:at] = chance.choice((b"\0", b'"', b"{", b"[" * 2000, b"9" * 5000, b"\xff"))
        elif kind == 3:
            del damaged[at : at + chance.randrange(1, 50)]
        else:
            damaged[at : at + 8] = struct.pack("<Q", chance.choice((0, 2**20, 2**40, 2**64 - 1)))
    return bytes(damaged)


def mutate_json(value: Any, chance: random.Random) -> Any:
    """Replace, remove or add a value somewhere."""
    changed = copy.deepcopy(value)
    for _ in range(chance.choice((1, 1, 2))):
        node = changed
        while True:
            keys = list(node) if isinstance(node, dict) else list(range(len(node)))
            if not keys:
                break
            key = chance.choice(keys)
            if isinstance(node[key], dict | list) and node[key] and chance.random() < 0.75:
                node = node[key]
                continue
            kind = chance.randrange(4)
            if kind == 0:
                del node[key]
            elif kind == 1 and isinstance(node, dict):
                node["extra"] = chance.choice(NASTY)
            else:
                node[key] = copy.deepcopy(chance.choice(NASTY))
            break
    return changed


def change_number(data: bytes, chance: random.Random) -> bytes:
    """Put another digit in the place of one."""
    digits = [at for at, byte in enumerate(data) if byte in b"0123456789"]
    at = chance.choice(digits)
    other = chance.choice([digit for digit in b"0123456789" if digit != data[at]])
    return data[:at] + bytes([other]) + data[at + 1 :]


class Target:
    """A kind of file: how to damage one, and how the program reads it."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / type(self).__name__.lower()

    def damage(self, chance: random.Random) -> int:
        """Write a damaged file; return its size in bytes."""
        raise NotImplementedError

    def read(self) -> None:
        """Use it as the program does."""
        raise NotImplementedError

    def _write(self, path: Path, data: bytes) -> int:
        path.write_bytes(data)
        return len(data)


class Checkpoint(Target):
    """Few, small tensors; metadata resealed."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.arrays = {"a": np.ones((30, 40), np.float32), "b": np.arange(3)}
        save_checkpoint(self.path, self.arrays, METADATA)
        self.good = self.path.read_bytes()

    def damage(self, chance: random.Random) -> int:
        if chance.random() < 0.6:
            return self._write(self.path, mutate_bytes(self.good, chance))
        return self._write(self.path, seal(self.arrays, mutate_json(METADATA, chance), chance))

    def read(self) -> None:
        load_checkpoint(self.path)
        models.show_info(QUIET, str(self.path))


class Networks(Target):
    """A whole model: its architecture is changed behind a good digest."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.arrays = tensors_of(build_modules(ARCHITECTURE))

    def damage(self, chance: random.Random) -> int:
        arrays = dict(self.arrays)
        name = chance.choice(sorted(arrays))
        if chance.random() < 0.2:
            del arrays[name]
        elif chance.random() < 0.2:
            arrays[name] = arrays[name][..., None]
        metadata = dict(METADATA)
        if chance.random() < 0.5:
            metadata["architecture"] = mutate_json(ARCHITECTURE, chance)
        else:
            metadata = mutate_json(metadata, chance)
        return self._write(self.path, seal(arrays, metadata, chance))

    def read(self) -> None:
        Model.load(self.path, "cpu")


class Dataset(Target):
    """The manifest, resealed, or a shard."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.path.mkdir()
        part = datasets.Trajectories(
            np.ones((3, 6, 4), np.float32), np.ones((3, 5), np.float32), np.ones((3, 5), np.float32)
        )
        datasets.write_manifest(
            self.path,
            settings={"seed": 0, "collect": load_settings().as_dict()["collect"]},
            shards=[
                datasets.write_shard(
                    self.path, datasets.Shard(number, split, 0, 3), part, "desktop"
                )
                for number, split in enumerate(("train", "clean"))
            ],
            plant_name="desktop",
            camera_manifest={},
        )
        self.manifest = json.loads((self.path / datasets.MANIFEST).read_text())
        self.shard = self.path / "shard-00000.safetensors"
        self.good = self.shard.read_bytes()

    def damage(self, chance: random.Random) -> int:
        manifest, shard = copy.deepcopy(self.manifest), self.good
        if chance.random() < 0.4:  # a shard that the manifest describes truthfully
            shard = mutate_bytes(shard, chance)
            digest = datasets.hashlib.sha256(shard).hexdigest()
            manifest["splits"]["train"]["shards"][0]["sha256"] = digest
        else:
            manifest = mutate_json(manifest, chance)
        if isinstance(manifest, dict) and "sha256" in manifest:
            manifest = seals.sealed(manifest)
        text = json.dumps(manifest).encode()
        if chance.random() < 0.2:
            text = mutate_bytes(text, chance)
        self._write(self.shard, shard)
        return len(shard) + self._write(self.path / datasets.MANIFEST, text)

    def read(self) -> None:
        found = datasets.load_dataset(self.path)
        for name in found.splits:
            found.split(name)
        data.show_info(QUIET, self.path)
        curves.Digest.of("0" * 64, load_settings(), found.settings)


class Curves(Target):
    """``curves.json`` up to the device counts made of it."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        measured = files.read_json(zoo.zoo_directory() / "desktop-reflex" / "curves.json")
        entry = measured["methods"]["chunk"]
        curves.write(self.path, DIGEST, {"chunk": entry})
        self.good = json.loads(self.path.read_text())

    def damage(self, chance: random.Random) -> int:
        document = mutate_json(self.good, chance)
        if isinstance(document, dict) and chance.random() < 0.7:  # a lie, not an accident
            document = seals.sealed(document)
        text = json.dumps(document).encode()
        if chance.random() < 0.2:
            text = mutate_bytes(text, chance)
        return self._write(self.path, text)

    def read(self) -> None:
        for method, entry in curves.read(self.path, DIGEST).items():
            for law in (DUTY, EQUAL):
                need = LinkRequirement.measured(law.axis, method, entry)
                law.row(need, Cell(20e6, 0.001, 10.0), 20.0)


class Derived(Target):
    """What was measured, one byte changed under its seal: the same values are read, or an error."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        settings = load_settings("smoke").as_dict()
        with runs.Run.create("eval", self.path, settings) as run:
            run.metric({"step": 1, "loss": 0.5})
            (self.path / "devices.csv").write_text("method,devices\nhold,12\n")
            run.finish({"score": 0.5, "rows": [{"devices": 12, "method": "hold"}]})
        shutil.copy(Curves(self.path).path, self.path / "curves.json")
        self.files = ("curves.json", "result.json", "metrics.csv", "devices.csv", "config.toml")
        self.good = {name: (self.path / name).read_bytes() for name in self.files}
        self.changed, self.expected = self.path / self.files[0], self._values()

    def damage(self, chance: random.Random) -> int:
        self.changed.write_bytes(self.good[self.changed.name])
        self.changed = self.path / chance.choice(self.files)
        data = bytearray(self.good[self.changed.name])
        data[chance.randrange(len(data))] = chance.choice(b'0123456789.-+e,:"{}x \n')
        return self._write(self.changed, bytes(data))

    def read(self) -> None:
        assert self._values() == self.expected, (
            f"{self.changed.name}: {self.changed.read_bytes()!r}"
        )

    def _values(self) -> Any:
        found = curves.read(self.path / "curves.json", DIGEST)
        return found, runs.read_result(self.path), runs.read_config(self.path)


class Shown(Target):
    """Runs whose numbers are printed: those of others with a good seal, ours with a bad one.

    A number that is changed behind a seal must be an error, or what is printed stays the same.
    Values of any kind under a right seal must be an error or be printed.
    """

    FILES = (runs.RESULT, runs.ENVIRONMENT, runs.CONFIG, runs.METRICS, "curves.json")

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.runs = [self._evaluated(0), self._evaluated(1), self._scaled(), self._trained()]
        self.page = report.page_template().make_module(dict.fromkeys(report.PARTS, ()))
        self.good = {run: self._bytes(run) for run in self.runs}
        self.run, self.forged = self.runs[0], False
        self.expected = {run: self._printed(run) for run in self.runs}

    def damage(self, chance: random.Random) -> int:
        for name, whole in self.good[self.run].items():
            (self.run / name).write_bytes(whole)
        self.run, self.forged = chance.choice(self.runs), chance.random() < 0.5
        name = chance.choice(sorted(self.good[self.run]))
        found = self.good[self.run][name]
        if not self.forged:
            return self._write(self.run / name, change_number(found, chance))
        if name in (runs.CONFIG, runs.METRICS):
            lie = mutate_bytes(found, chance)
        else:
            document = mutate_json(json.loads(found), chance)
            has_seal = isinstance(document, dict) and "sha256" in document
            lie = json.dumps(seals.sealed(document) if has_seal else document).encode()
        size = self._write(self.run / name, lie)
        if name not in (runs.RESULT, "curves.json"):  # which the result names
            result = json.loads(self.good[self.run][runs.RESULT])
            result["files"][name] = hashlib.sha256(lie).hexdigest()
            self._write(self.run / runs.RESULT, json.dumps(seals.sealed(result)).encode())
        return size

    def read(self) -> None:
        printed = self._printed(self.run)
        assert self.forged or printed == self.expected[self.run], "printed another number"

    def _printed(self, run: Path) -> Any:
        one = report.describe(run)
        one["figures"] = one["lacking"] = []
        screen = Screen(stdout=io.StringIO(), stderr=io.StringIO())
        try:
            text = str(self.page.section(one))
        except (LookupError, TypeError, ValueError, ArithmeticError) as error:
            raise results.damaged(run, one["stage"], error) from None
        with results.showing(one["stage"], one["result"], run):
            if one["stage"] == "eval":
                tables.show_evaluation(one["result"], screen)
            elif one["stage"] == "train-encoder":
                tables.show_gates(screen, one["result"]["gates"], enforced=True)
        compared = None
        if one["stage"] == "eval":
            compared = self._compared()
            curves.read(run / "curves.json", DIGEST)
        resume.recall(run, screen)
        return text, screen._stdout.getvalue(), compared

    def _compared(self) -> Any:
        found = [compare.open_evaluation(run, None) for run in self.runs[:2]]
        compare.check_alike(found)
        by_method, _ = compare.collected(found, None)
        averaged = {name: compare.averaged(list(of.values())) for name, of in by_method.items()}
        return averaged, compare.differences(by_method)

    def _bytes(self, run: Path) -> dict[str, bytes]:
        return {name: (run / name).read_bytes() for name in self.FILES if (run / name).exists()}

    def _evaluated(self, seed: int) -> Path:
        measured = files.read_json(zoo.zoo_directory() / "desktop-h4m2l1" / "curves.json")
        methods = {name: measured["methods"][name] for name in ("hjepa", "ts-jepa-4")}
        directory, settings = self.path / f"eval-{seed}", load_settings("smoke").as_dict()
        with runs.Run.create("eval", directory, settings) as run:
            curves.write(directory / "curves.json", DIGEST, methods)
            run.finish(
                {
                    "plant": "desktop", "seed": seed, "checkpoint": "m", "loop_version": 6,
                    "acceptable_score": 0.62, "acceptable_lq_ratio": 0.5, "methods": methods,
                    "horizon": list(range(len(methods["hjepa"]["nmae"]))),
                    "training_seeds": dict.fromkeys(methods, seed), "source": "curves",
                }
            )  # fmt: skip
        return directory

    def _scaled(self) -> Path:
        measured = files.read_json(zoo.zoo_directory() / "desktop-h4m2l1" / "curves.json")
        rows = [
            DUTY.row(
                LinkRequirement.measured(DUTY.axis, name, measured["methods"][name]),
                Cell(20e6, 0.001, 10.0),
                snr_db,
            )
            for name in ("hjepa", "ts-jepa-4")
            for snr_db in (10.0, 20.0)
        ]
        gain = {"method": "hjepa", "over": "ts-jepa-4", "snr_db": 20.0, "ratio": 1.1}
        with runs.Run.create("scale", self.path / "scale", load_settings().as_dict()) as run:
            run.finish(
                {
                    "plant": "desktop", "seed": 0, "law": "duty", "bandwidth_hz": 20e6,
                    "slot_s": 0.001, "acceptable_score": 0.62, "n_devices": 64,
                    "limit_bits_per_s": 13.2, "paper_gain_percent": 42.8, "rows": rows,
                    "gains": [gain | {"ratio_ci95": [1.0, 1.2]}],
                }
            )  # fmt: skip
        return run.directory

    def _trained(self) -> Path:
        gates = {"effective_rank": {"value": 9.5, "threshold": 4.0, "passed": True}}
        with runs.Run.create(
            "train-encoder", self.path / "trained", load_settings().as_dict()
        ) as run:
            for step in (1, 2):
                run.metric({"step": step, "loss": 0.5 / step})
            run.finish({"checkpoint": "m", "seconds": 12.5, "gates": gates})
        return run.directory


class Records(Target):
    """What a run and a collection remember: ``environment.json``, ``collecting.jsonl``."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        with runs.Run.create("eval", self.path, load_settings().as_dict(), {"remeasure": True}):
            self.good = json.loads((self.path / runs.ENVIRONMENT).read_text())

    def damage(self, chance: random.Random) -> int:
        text = json.dumps(mutate_json(self.good, chance)).encode()
        if chance.random() < 0.3:
            text = mutate_bytes(text, chance)
        task = seals.sealed({"seed": 1, "schema": chance.choice((1, shards.SCHEMA))})
        log = json.dumps(task).encode() + b'\n{"name":"shard-00000.safetensors","sha256":"0"}\n'
        self._write(self.path / shards.LOG, mutate_bytes(log, chance))
        return self._write(self.path / runs.ENVIRONMENT, text)

    def read(self) -> None:
        try:
            shards.ShardLog(self.path, {"seed": 1})
        except HjepaError:
            pass
        runs.read_environment(self.path)


class Progress(Target):
    """The saved state of a training: bytes, or resealed metadata and tensors."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.run = runs.Run.create("eval", self.path, load_settings().as_dict())
        self.run.close()  # nobody else works there
        self.run.resumed = True
        self.file = self.path / progress.PROGRESS_FILE
        for _ in self._start().steps("a", 2, *self._parts()):
            pass
        saved = load_checkpoint(self.file)
        self.good, self.arrays, self.metadata = (
            self.file.read_bytes(),
            saved.tensors,
            saved.metadata,
        )

    def _start(self) -> progress.Progress:
        return progress.Progress(self.run, QUIET.say)

    def _parts(self) -> tuple[dict[str, progress.Part], np.random.Generator]:
        layer = torch.nn.Linear(2, 2)
        optimiser = Optimiser(
            layer.parameters(),
            name="adamw",
            schedule="constant",
            steps=2,
            learning_rate=0.1,
            weight_decay=0.0,
            gradient_clip=0.0,
        )
        optimiser.step(layer(torch.ones(1, 2)).sum(), 0)
        return {"layer": layer, "optimiser": optimiser}, np.random.default_rng(0)

    def damage(self, chance: random.Random) -> int:
        if chance.random() < 0.3:
            return self._write(self.file, mutate_bytes(self.good, chance))
        arrays = dict(self.arrays)
        if chance.random() < 0.4:
            name = chance.choice(sorted(arrays))
            array = arrays.pop(name)
            if chance.random() < 0.7:
                cut, whole = np.atleast_1d(array)[..., :1], array.astype(np.int64)
                name = chance.choice((name, "layer.x", "optimiser.-1.step"))
                arrays[name] = chance.choice((cut, whole, array[None], -array))
        metadata = mutate_json(self.metadata, chance) if chance.random() < 0.7 else self.metadata
        return self._write(self.file, seal(arrays, metadata, chance))

    def read(self) -> None:
        threads = torch.get_num_threads()
        parts, stream = self._parts()
        try:
            started = self._start()
            for _ in started.steps("a", 3, parts, stream):
                parts["optimiser"].step(parts["layer"](torch.ones(1, 2)).sum(), 0)  # type: ignore
                stream.random()
        finally:
            torch.set_num_threads(threads)


class Toml(Target):
    """``--config FILE.toml``."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.good = load_settings().as_dict()

    def damage(self, chance: random.Random) -> int:
        settings = mutate_json(self.good, chance)
        try:
            text = runs.to_toml(settings).encode()
        except (TypeError, ValueError):
            text = runs.to_toml(self.good).encode()
        if chance.random() < 0.5:
            text = mutate_bytes(text, chance)
        return self._write(self.path, text)

    def read(self) -> None:
        check_settings(load_settings(config=self.path))


TARGETS: tuple[type[Target], ...] = (
    Checkpoint,
    Dataset,
    Curves,
    Derived,
    Shown,
    Records,
    Progress,
    Toml,
    Networks,
)
SHARES = (25, 20, 12, 6, 5, 11, 8, 12, 1)  # in percent; a model takes as long as a hundred others


def seal(arrays: dict[str, Any], metadata: Any, chance: random.Random) -> bytes:
    """A checkpoint whose digest is right, whatever its metadata says."""
    sealed = {**metadata, "schema": chance.choice((1, 1, 1, 1, 1, 2, "1"))}
    return tensors.pack(arrays, files.canonical_json(seals.sealed(sealed, arrays)))


def check(target: Target, chance: random.Random, *, measure: bool = False) -> str:
    """Damage and read one file; return the kind of outcome.

    Args:
        measure: watch memory, which makes it some times slower.

    Raises:
        AssertionError: too slow, or too much memory.
        Exception: anything but an error for people.
    """
    size = target.damage(chance)
    if measure:
        tracemalloc.start()
    started = time.process_time()  # other programs do not count
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Unsealed)
            target.read()
        outcome = "accepted"
    except HjepaError as error:
        assert "\n" not in error.message.strip()[:2000], error.message
        outcome = type(error).__name__
    finally:
        peak = tracemalloc.get_traced_memory()[1] if measure else 0
        tracemalloc.stop()
    assert time.process_time() - started < SLOWEST_S, "too slow"
    assert peak <= 2 * size + OVERHEAD_BYTES, f"{peak} bytes for a file of {size}"
    return outcome


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--measure-every", type=int, default=10, help="watch memory in every Nth")
    parser.add_argument("--only", choices=[kind.__name__ for kind in TARGETS], help="one kind")
    options = parser.parse_args()
    torch.set_num_threads(1)
    outcomes: collections.Counter[tuple[str, str]] = collections.Counter()
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        wanted = [kind for kind in TARGETS if options.only in (None, kind.__name__)]
        targets = [kind(Path(folder)) for kind in wanted]
        for case in range(options.cases):
            chance = random.Random(options.seed * 10**9 + case)
            (target,) = chance.choices(targets, None if options.only else SHARES)
            try:
                outcome = check(target, chance, measure=case % options.measure_every == 0)
            except Exception:
                print(
                    f"case {case} of seed {options.seed}: {type(target).__name__}", file=sys.stderr
                )
                raise
            outcomes[type(target).__name__, outcome] += 1
    seconds = time.perf_counter() - started
    print(f"{options.cases} cases in {seconds:.0f} s ({options.cases / seconds:.0f} a second)")
    for (name, outcome), count in sorted(outcomes.items()):
        print(f"{count:8}  {name:12}{outcome}")


if __name__ == "__main__":
    main()
