"""Files that a reader must survive: bombs, pipes, chains, numbers without end, tags at the wrong place, bad bytes.

Every one is refused with one message that names the file, in seconds and in little memory, or read as it is meant.
`benchmarks/fuzz.py` makes many more of them.
"""

from __future__ import annotations

import io
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import tasks

from figaroh_jax.errors import InputError, nearest
from figaroh_jax.formats.config import load_task
from figaroh_jax.formats.mjcf import load_mjcf
from figaroh_jax.formats.robotfile import load_extended
from figaroh_jax.formats.taskfile import read_yaml
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.recordings.reading import read_table

ROOT = Path(__file__).resolve().parents[1]
MJCF = """<mujoco><worldbody><body name="link" pos="0 0 1"><inertial pos="0 0 .1" mass="1" diaginertia=".1 .1 .1"/>
<joint name="hinge" axis="0 1 0" range="-1 1" armature=".1" damping=".1" stiffness="1" frictionloss=".1"/>
</body></worldbody></mujoco>"""


def refused(call, *words: str) -> str:
    with pytest.raises(InputError) as caught:
        call()
    message = str(caught.value)
    assert all(word in message for word in words), message
    assert len(message) < 20_000
    return message


YAML = {
    "a list as a key": ("? [a]\n: 1\n", "line 1", "a key is a list"),
    "a mapping as a key": ("{{a: 1}: 2}\n", "line 1", "a key is a list or a mapping"),
    "a timestamp that is none": ("a: !!timestamp abc\n", "cannot be read as YAML"),
    "a bool that is none": ("a: !!bool maybe\n", "cannot be read as YAML"),
    "half of a character": ('"\\uD800": 1\n', "line 1", "half a character"),
    "an int that is none": ("a: !!int abc\n", "cannot be read as YAML"),
    "a set of a scalar": ("a: !!set abc\n", ""),
    "a mapping of a scalar": ("a: !!map abc\n", ""),
    "Python": ("a: !!python/object/apply:os.mkdir [ran]\n", "python/object"),
    "an unknown alias": ("a: *b\n", "line 1"),
    "an alias in itself": ("a: &a [*a]\n", "is inside what it refers to"),
    "nested": ("[" * 5000, ""),
    "laughs": (
        "a: &a [x, x, x, x, x, x, x, x, x]\n"
        + "".join(f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)),
        "more than 50000 values",
    ),
    "laughs by merging": (
        "a: &a {x: 1}\n"
        + "".join(
            f"{b}: &{b} {{<<: [{', '.join([f'*{a}'] * 20)}]}}\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
        ),
        "more than 50000 values",
    ),
    "no UTF-8": (b"a: \xff\n", "cannot be read as YAML"),
    "null bytes": ("a: \0\n", ""),
}


@pytest.mark.parametrize("kind", YAML)
def test_yaml_of_every_kind_is_refused_or_read(tmp_path: Path, monkeypatch, kind: str):
    monkeypatch.chdir(tmp_path)
    text, *words = YAML[kind]
    file = tmp_path / "task.yaml"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    refused(lambda: read_yaml(file), "task.yaml", *words)
    assert not (tmp_path / "ran").exists()


def test_yaml_aliases_are_read(tmp_path: Path):
    tasks.write(tmp_path)
    text = (tmp_path / "task.yaml").read_text().replace("position: q", "position: &name q", 1)
    text = text.replace("position: q", "position: *name")
    text += "baseline: {effects: [{effect: joint_spring, at: &at [elbow]}, {effect: torque_offset, at: *at}]}\n"
    (tmp_path / "task.yaml").write_text(text)
    task = load_task(tmp_path / "task.yaml")
    assert [entry.position for entry in task.data] == ["q", "q"]
    assert [effect.at for effect in task.baseline.effects] == [("elbow",), ("elbow",)]


def test_a_number_in_base_60_of_any_length_is_read_in_time(tmp_path: Path):
    (tmp_path / "task.yaml").write_text("a: 1" + ":1" * 100_000)
    assert isinstance(read_yaml(tmp_path / "task.yaml")["a"], str)


PATHS = ["\0", "a\0b.urdf", "n" * 300, "n" * 300 + ".npz", "x/" * 3000, "", ".", "task.yaml/x", "\ud800"]


@pytest.mark.parametrize("path", PATHS)
def test_names_that_no_file_has_are_refused(tmp_path: Path, path: str):
    refused(lambda: read_yaml(tmp_path / path))
    refused(lambda: load_urdf(tmp_path / f"{path}.urdf"))
    refused(lambda: load_mjcf(tmp_path / f"{path}.xml"))
    refused(lambda: read_table(tmp_path / f"{path}.npz", "data[0].file"))


@pytest.mark.parametrize("suffix", [".urdf", ".xml", ".npz", ".csv", ".parquet", ".yaml"])
def test_nobody_waits_for_a_pipe(tmp_path: Path, suffix: str):
    file = tmp_path / f"pipe{suffix}"
    os.mkfifo(file)
    readers = {".urdf": load_urdf, ".xml": load_mjcf, ".yaml": read_yaml}
    refused(lambda: readers.get(suffix, lambda file: read_table(file, "data"))(file), "a pipe")
    link = tmp_path / f"device{suffix}"
    link.symlink_to("/dev/zero")
    refused(lambda: readers.get(suffix, lambda file: read_table(file, "data"))(link), "a device")


def _npz(file: Path, **arrays: np.ndarray) -> Path:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            memory = io.BytesIO()
            np.lib.format.write_array(memory, array)
            archive.writestr(f"{name}.npy", memory.getvalue())
    return file


def test_arrays_are_bounded_by_what_they_become(tmp_path: Path):
    file = tmp_path / "run.npz"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("q.npy", "w") as entry:
        np.lib.format.write_array_header_1_0(entry, {"descr": "|i1", "fortran_order": False, "shape": (1 << 28,)})
        for _ in range(256):
            entry.write(bytes(1 << 20))
    assert file.stat().st_size < 1 << 20
    refused(lambda: read_table(file, "data").read("q"), "'q'", "2048 MiB as float64")


def test_parquet_is_bounded_by_what_it_becomes(tmp_path: Path):
    import pyarrow as pa
    from pyarrow import parquet

    file = tmp_path / "run.parquet"
    same = pa.DictionaryArray.from_arrays(pa.array(np.zeros(1 << 20, np.int8)), pa.array([1.0]))
    parquet.write_table(pa.table({f"q{k}": same for k in range(80)}), file)
    assert file.stat().st_size < 1 << 20
    refused(lambda: read_table(file, "data"), "640 MiB")


@pytest.mark.parametrize(
    "array",
    [
        np.zeros(4, complex),
        np.array([""] * 4),
        np.array([], dtype="U1"),
        np.zeros((4, 0), "U1"),
        np.array([b""] * 4),
        np.zeros(4, [("x", float)]),
        np.zeros(4, "m8[s]"),
    ],
)
def test_arrays_that_are_no_numbers_are_refused(tmp_path: Path, array: np.ndarray):
    refused(lambda: read_table(_npz(tmp_path / "run.npz", q=array), "data").read("q"), "run.npz", "'q'")


def test_damaged_zip_directories_are_refused(tmp_path: Path):
    file = _npz(tmp_path / "run.npz", q=np.zeros(40))
    whole = file.read_bytes()
    for at in range(len(whole) - 80, len(whole)):
        file.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
        try:
            read_table(file, "data").vector("q", "data[0].position")
        except InputError as error:
            assert "run.npz" in str(error)


def test_csv_headers_of_any_kind(tmp_path: Path):
    file = tmp_path / "run.csv"
    file.write_bytes(b"t,q\xff1\n0,1\n1,2\n")
    refused(lambda: read_table(file, "data"), "run.csv", "UTF-8")
    file.write_text(",".join(f"column_{k}_" + "x" * 90 for k in range(9000)) + "\n" + ",".join("0" * 9000) + "\n")
    assert "did you mean" in refused(lambda: _missing(file), "run.csv")
    file.write_text(",".join(f"c{k}" for k in range(20_000)) + "\n" + ",".join("0" * 20_000) + "\n")
    refused(lambda: read_table(file, "data"), "20000 columns")
    file.write_text("x" * (1 << 20) + "\n1\n")
    refused(lambda: read_table(file, "data"), "first line")


def _missing(file: Path) -> None:
    read_table(file, "data").vector("column_12_xxx" + "x" * 86, "time")


def test_the_nearest_name_is_found_among_few_and_short_ones():
    assert nearest("joint_l", [f"joint_{k}" for k in range(5)]).startswith("; did you mean 'joint_")
    assert len(nearest("nothing", (str(k) * 1000 for k in range(10**5)))) < 20_000


def _chain(count: int) -> str:
    links = "".join(f"<link name='l{k}'/>" for k in range(count + 2))
    mimic = "".join(
        f"<joint name='j{k + 1}' type='revolute'><parent link='l{k + 1}'/><child link='l{k + 2}'/><axis xyz='0 0 1'/>"
        f"<mimic joint='j{k}'/></joint>"
        for k in reversed(range(count))
    )
    first = "<joint name='j0' type='revolute'><parent link='l0'/><child link='l1'/><axis xyz='0 0 1'/></joint>"
    return f"<robot name='r'>{links}{mimic}{first}</robot>"


def test_long_chains_of_mimic_joints_are_read_and_longer_ones_refused(tmp_path: Path):
    file = tmp_path / "robot.urdf"
    file.write_text(_chain(1500))
    assert load_urdf(file).nv == 1
    file.write_text(_chain(2500))
    refused(lambda: load_urdf(file), "robot.urdf", "2502 links; a robot has at most 2000")


REPEATED = {
    "replicate": ('<replicate count="20000" offset="0 0 1"><body/></replicate>', "at most 2000"),
    "replicate in replicate": (
        '<replicate count="100" offset="0 0 1"><replicate count="100" offset="1 0 0"><body/></replicate></replicate>',
        "at most 2000",
    ),
    "composite": ('<composite type="particle" count="99999 1 1"/>', "99999"),
}


@pytest.mark.parametrize("kind", REPEATED)
def test_elements_that_make_much_of_little_are_bounded(tmp_path: Path, kind: str):
    text, words = REPEATED[kind]
    file = tmp_path / "robot.xml"
    file.write_text(MJCF.replace("<worldbody>", f"<worldbody>{text}"))
    refused(lambda: load_mjcf(file), "robot.xml", words)
    file.write_text(MJCF.replace("<worldbody>", '<worldbody><include file="more.xml"/>'))
    (tmp_path / "more.xml").write_text(f"<mujocoinclude>{text}</mujocoinclude>")
    refused(lambda: load_mjcf(file), "robot.xml", words)
    for asset in (
        '<hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/>',
        '<texture name="t" type="2d" builtin="flat" width="100000" height="100000"/>',
    ):
        file.write_text(MJCF.replace("<worldbody>", f"<asset>{asset}</asset><worldbody>"))
        refused(lambda: load_mjcf(file), "100000")


NUMBERS = {
    "position": ('pos="0 0 1"', 'pos="0 0 {}"'),
    "axis": ('axis="0 1 0"', 'axis="0 {} 0"'),
    "range": ('range="-1 1"', 'range="-1 {}" limited="true"'),
    "armature": ('armature=".1"', 'armature="{}"'),
    "damping": (' damping=".1"', ' damping="{}"'),
    "stiffness": ('stiffness="1"', 'stiffness="{}"'),
    "frictionloss": ('frictionloss=".1"', 'frictionloss="{}"'),
    "ref": ('name="hinge"', 'name="hinge" ref="{}"'),
    "mass": ('mass="1"', 'mass="{}"'),
    "inertia": ('diaginertia=".1 .1 .1"', 'diaginertia="{0} {0} {0}"'),
    "centre of mass": ('pos="0 0 .1"', 'pos="0 0 {}"'),
}


@pytest.mark.parametrize("value", ["nan", "1e200", "1e15"])
@pytest.mark.parametrize("what", NUMBERS)
def test_numbers_that_no_robot_has_are_refused_by_name(tmp_path: Path, what: str, value: str):
    """Or read so that nothing of the model is without bound: MuJoCo itself normalises an axis."""
    right, wrong = NUMBERS[what]
    assert right in MJCF
    file = tmp_path / "robot.xml"
    file.write_text(MJCF.replace(right, wrong.format(value)))
    try:
        robot = load_extended(file).model.robot
    except InputError as error:
        assert "robot.xml: " in str(error) and any(word in str(error) for word in ("'hinge'", "'link'", "MuJoCo"))
    else:
        assert value != "nan" and what in ("axis", "range", "ref")
        assert all(np.isfinite(np.asarray(getattr(robot, leaf))).all() for leaf in ("placement", "axis", "inertia"))


def test_products_that_overflow_are_refused_by_name(tmp_path: Path):
    file = tmp_path / "robot.urdf"
    file.write_text(
        tasks.URDF.replace('<mass value="3.0"/>', '<mass value="1e300"/>').replace("0 0 0.2", "0 0 1e300", 1)
    )
    refused(lambda: load_urdf(file), "robot.urdf", "'upper'", "mass, centre of mass or inertia")
    file.write_text(tasks.URDF.replace("0 0 0.4", "0 0 1e200"))
    refused(lambda: load_urdf(file), "robot.urdf", "'elbow'", "the placement")


@pytest.mark.parametrize("attribute", ["damping", "friction"])
def test_drives_that_push_are_refused(tmp_path: Path, attribute: str):
    file = tmp_path / "robot.urdf"
    file.write_text(tasks.URDF.replace('<axis xyz="1 0 0"/>', f'<axis xyz="1 0 0"/><dynamics {attribute}="-1"/>'))
    refused(lambda: load_extended(file), "robot.urdf", "'elbow'", attribute, "-1")
    file = tmp_path / "robot.xml"
    name = {"damping": "damping", "friction": "frictionloss"}[attribute]
    file.write_text(MJCF.replace(f' {name}=".1"', f' {name}="-1"'))
    refused(lambda: load_extended(file), "robot.xml", name)


def test_an_inertial_with_two_masses_is_refused(tmp_path: Path):
    """Two `<inertial>` of a link are read as other readers do, the first with a note: published robots have them."""
    mass = tasks.URDF[tasks.URDF.index("<mass") : tasks.URDF.index("/>", tasks.URDF.index("<mass")) + 2]
    file = tmp_path / "robot.urdf"
    file.write_text(tasks.URDF.replace(mass, mass * 2, 1))
    refused(lambda: load_urdf(file), "robot.urdf", "'upper'", "2 <mass>")


WITHOUT_TYPES = """
import numpy as np, figaroh_jax as fj
from figaroh_jax.rigid import derivatives, manifold
m, c = fj.load_urdf(fj.DEMO), np.full((20, 4), 0.3 + 0.1j)
x, last, none = c.real, m.frames[-1].name, np.zeros((2, 0, 4))
refused = {
    "tau holds complex": lambda: fj.recording(q=x, tau=c, rate=100),
    "time holds complex": lambda: fj.recording(q=x, tau=x, time=c[:, 0]),
    "position holds complex": lambda: fj.postures(q=x, position=c[:, :3], base_frame="base", tool_frame="hand"),
    "the stamps look like ns": lambda: fj.recording(q=x, tau=x, time=np.arange(20) * 1e7),
    "not an array of numbers": lambda: fj.recording(q=[[0.1], [0.1, 0.2]], tau=x, rate=100),
    "q holds text": lambda: fj.mass_matrix(m, [["1", "2", "3", "4"]]),
    "q holds objects": lambda: fj.mass_matrix(m, [[None] * 4]),
    "q is not an array of numbers": lambda: fj.mass_matrix(m, [[0.1], [0.1, 0.2]]),
    "q has shape ()": lambda: derivatives.coriolis_matrix(m, 3.0, none),
}
complex_ones = {
    "q": [lambda: fj.inverse_dynamics(m, c, x, x), lambda: fj.mass_matrix(m, c), lambda: fj.frame_placement(m, c, last),
          lambda: derivatives.gravity_vector(m, c), lambda: fj.backend("native", m).mass_matrix(c)],
    "v": [lambda: fj.joint_torque_regressor(m, x, c, x), lambda: derivatives.coriolis_matrix(m, x, c),
          lambda: manifold.integrate(m, x, c)],
    "a": [lambda: derivatives.dynamics_derivatives(m, x, x, c), lambda: fj.packed_regressor(m, x, x, c)],
    "tau": [lambda: fj.normal_matrix(m, x, x, x, c), lambda: fj.forward_dynamics(m, x, x, c)],
    "weight": [lambda: fj.normal_matrix(m, x, x, x, x, weight=c)],
    "time": [lambda: fj.predict(fj.extend(m), c[:, 0], x, x, x, 0.01)],
}
calls = [(f"{name} holds complex numbers", call) for name, some in complex_ones.items() for call in some]
for words, call in [*refused.items(), *calls]:
    try:
        call()
        print("accepted:", words)
    except fj.InputError as error:
        if words not in str(error):
            print("other message:", words, "|", error)
assert derivatives.coriolis_matrix(m, none, none).shape == (2, 0, 4, 4)
assert {x.shape for x in derivatives.dynamics_derivatives(m, none, none, none)} == {(2, 0, 4, 4)}
"""


def test_no_imaginary_part_is_dropped_no_text_is_a_number_and_no_samples_give_empty_answers():
    """In an interpreter of its own, where nothing but the library checks the arguments."""
    run = subprocess.run([sys.executable, "-c", WITHOUT_TYPES], capture_output=True, text=True)
    assert run.returncode == 0 and run.stdout == "", run.stdout + run.stderr


def test_the_one_minute_fuzz_finds_nothing_in_its_first_inputs(tmp_path: Path):
    command = [
        sys.executable,
        str(ROOT / "benchmarks" / "fuzz.py"),
        "--count",
        "100",
        "--seed",
        "9",  # `make fuzz` draws fresh ones
        "--guide",
        "50",
        "--keep",
        str(tmp_path / "found"),
    ]
    run = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert run.returncode == 0, run.stdout + run.stderr
    assert "100 inputs" in run.stdout
