"""What the tests of the GPU kit share: a part's arguments, its lines, a carried store, a checkpoint's size."""

import zipfile

import kit
import part_latency

from manicm_ms.policies.methods import METHODS, make_policy


def lines_of(out):
    return kit.Results.read(out / "results.jsonl")


def arguments(tmp_path, *more):
    places = {name: tmp_path / name for name in ("out", "work", "load")}
    for place in places.values():
        place.mkdir(exist_ok=True)
    words = [word for name, place in places.items() for word in (f"--{name}", str(place))]
    return [*words, "--smoke", *more]


def stored_bytes(method):
    """In half precision and for a larger hand than hammer's; zip cannot be relied on to shrink it."""
    policy = make_policy(method, part_latency.door_spec(), METHODS.get(method).chunk_of("paper"), seed=0)
    return 2 * sum(value.numel() for value in policy.state_dict().values())


def pack_store(store, load):
    packed = load / "stores" / "test" / f"{store.stem}.zip"
    packed.parent.mkdir(parents=True)
    with zipfile.ZipFile(packed, "w") as archive:
        for file in (path for path in store.rglob("*") if path.is_file()):
            archive.write(file, f"{store.name}/{file.relative_to(store)}")
