"""Wrong inputs to stations, live runs and verbs of tracks, through the command line: refused in one line."""

import socket
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "hardware"))

from needs import needs_module

DETECT = "detect --name A --connect tcp/127.0.0.1:7 --rig plain.toml --recording "
RECONSTRUCT = "reconstruct --rig plain.toml --seconds 0.1 "
HERE = RECONSTRUCT + "--stations A --listen tcp/127.0.0.1:0 "


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ("detect --name A --connect tcp/127.0.0.1:7 --rig none.toml", "none.toml: no such file"),
        ("detect --name A --connect tcp/127.0.0.1:7 --rig bytes.toml", "bytes.toml: cannot be read"),
        ("detect --name A --connect tcp/127.0.0.1:7 --rig plain.toml", "has no [camera.hardware]"),
        (DETECT + "nope", "nope: no such folder"),
        (DETECT + "full", "full: no recording in it"),
        (DETECT + "take --fps 0", "0.0 is not in the range"),
        (DETECT + "take --seconds nan", "nan is no finite number"),
        (DETECT + "take --settings none.toml", "none.toml: no such file"),
        (DETECT + "take --set x=1", "unknown key 'x'"),
        (DETECT + "take --set detection.contrast_dn=-1", "-1 given"),
        (DETECT + "take --connect nonsense", "endpoint 'nonsense': endpoints look like tcp/"),
        (DETECT + "take --connect tcp/1.2.3.4", "endpoint 'tcp/1.2.3.4'"),
        (DETECT + "take --connect tcp/1.2.3.4:99999", "endpoint 'tcp/1.2.3.4:99999'"),
        (DETECT + "take --connect ||", "endpoint ''"),
        (DETECT + "take --name |a b|", "station name 'a b' given"),
        (HERE + "--out x.xyz", "suffix '.xyz' given"),
        (HERE + "--out nowhere/x.csv", "there is no folder nowhere"),
        (HERE + "--out full.csv", "full.csv: is a folder"),
        (HERE + "--out /proc/x.csv", "/proc/x.csv: cannot be written"),
        (HERE + "--out x.csv", "endpoint 'tcp/127.0.0.1:0'"),
        (HERE + "--out x.csv --deadline-ms nan", "nan is no finite number"),
        (HERE + "--out x.csv --deadline-ms -1", "-1.0 is not in the range"),
        (HERE + "--out x.csv --settings none.toml", "none.toml: no such file"),
        (HERE + "--out x.csv --rig none.toml", "none.toml: no such file"),
        (HERE + "--out x.csv --rig bytes.toml", "bytes.toml: cannot be read"),
        (RECONSTRUCT + "--out x.csv --stations A,A --listen tcp/127.0.0.1:7477", "one or more different names"),
        (RECONSTRUCT + "--out x.csv --stations A --listen nonsense", "endpoints look like tcp/"),
        (RECONSTRUCT + "--out x.csv --stations , --listen tcp/127.0.0.1:7477", "one or more different names"),
        (RECONSTRUCT + "--out x.csv --stations A --insecure --listen tcp/10.99.99.99:7447", "has no such address"),
        (RECONSTRUCT + "--out x.csv --stations A --listen tcp/0.0.0.0:7447", "is open to the network, and no key"),
        (RECONSTRUCT + "--out x.csv --stations A --listen tcp/[::]:7447", "is open to the network, and no key"),
        (DETECT.replace("127.0.0.1", "10.0.0.1") + "take", "endpoint 'tcp/10.0.0.1:7': is open to the network"),
        (HERE + "--out x.csv --key none.key", "none.key: No such file or directory; make a key with"),
        (HERE + "--out x.csv --key plain.toml", "plain.toml: is no key; one line of 64"),
        (HERE + "--out x.csv --key plain.toml --insecure", "leave one of them out"),
        ("key plain.toml", "plain.toml: exists"),
        ("rig --connect tcp/127.0.0.1:7 --out nowhere/x.toml", "there is no folder nowhere"),
        ("rig --connect tcp/127.0.0.1:7 --out full.toml", "full.toml: is a folder"),
        ("rig --connect nonsense --out x.toml", "endpoint 'nonsense'"),
        ("rig --of |a b| --connect tcp/127.0.0.1:7 --out x.toml", "station name 'a b' given"),
    ],
)
def test_stations(refused, given, told):
    needs_module("zenoh", "stations")
    assert told in refused("station " + given)


def test_a_port_that_somebody_listens_to(refused):
    needs_module("zenoh", "stations")
    with socket.create_server(("127.0.0.1", 0)) as other:
        endpoint = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        given = "station " + RECONSTRUCT + "--stations A --out x.csv --listen"
        assert "another program listens there" in refused(given, endpoint)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ("run any_source --out new --source hardware:rig.toml", "rig.toml: no camera 'cam1', which the scenario's"),
        ("run any_source --out new --source hardware:none.toml", "none.toml: no such file"),
        ("run any_source --out new --source hardware:", "allowed are twin, recording:DIR and hardware:RIG.toml"),
        ("run any_source --out new --source hardware:plain.toml", "has no [camera.hardware]"),
        ("run any_source --out new --source usb:rig.toml", "allowed are twin"),
        ("run any_source --out new --source recording:take", "no camera 'cam1' of the rig"),
        ("run any_source --out full --source hardware:rig.toml", "full: holds other files"),
        ("run any_source --out file.txt --source hardware:rig.toml", "file.txt: is a file"),
        ("run any_source --out file.txt/x --source hardware:rig.toml", "file.txt"),
        ("rig check", "give a rig file, --devices for the cameras that are there, or"),
        ("rig check --live", "give the rig file"),
        ("rig check --flash nope", "nope: no such folder"),
        ("rig check --flash full", "full: no recording in it"),
        ("rig check --flash take", "camera 'a1'"),
        ("rig check rig.toml --flash take", "leave rig file, --devices and --live out"),
        ("rig check --devices --flash take", "leave rig file, --devices and --live out"),
        ("rig check --devices --fps 30", "--fps goes with --flash"),
        ("rig check --flash take --fps nan", "nan is no finite number"),
        ("rig check none.toml", "none.toml: no such file"),
        ("rig check none.toml --devices", "none.toml: no such file"),
        ("rig check bytes.toml --devices", "bytes.toml: cannot be read"),
        ("rig check plain.toml --devices", "has no [camera.hardware]"),
        ("rig check take", "take: is a folder; a TOML file is wanted"),
    ],
)
def test_runs_from_devices_and_rig_checks(refused, given, told):
    assert told in refused(given)


TAKE = "recording:take --rig plain.toml "


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ("", "Missing argument 'SOURCE'"),
        ("nothing_here", "nothing_here: no such scenario or file"),
        ("any_sourc", "did you mean"),
        ("hardware:", "allowed are hardware:RIG.toml, recording:DIR and a scenario"),
        ("recording:", "allowed are hardware:RIG.toml, recording:DIR and a scenario"),
        ("hardware:none.toml", "none.toml: no such file"),
        ("hardware:plain.toml", "has no [camera.hardware]"),
        ("hardware:rig.toml --rate 3", "--rate and --fps are of recordings"),
        ("hardware:rig.toml --rig other.toml", "unknown key 'title'"),
        ("recording:take", "--rig RIG.toml is wanted"),
        ("recording:take --rig none.toml", "none.toml: no such file"),
        ("recording:nope --rig plain.toml", "nope: no such folder"),
        ("any_source --rig plain.toml", "a scenario has its own"),
        ("any_source --set zz=1", "unknown key 'zz'"),
        (TAKE + "--seconds nan", "nan is no finite number"),
        (TAKE + "--rate inf", "inf is no finite number"),
        (TAKE + "--fps 0", "0.0 is not in the range"),
        (TAKE + "--queued 0", "0 is not in the range"),
        (TAKE + "--lag -1", "lag = -1 given"),
        (TAKE + "--settings none.toml", "none.toml: no such file"),
        (TAKE + "--settings background.toml", "a live run has no first pass"),
        (TAKE + "--set track.gate_m=-1", "-1 given"),
        (TAKE + "--set background.kind=mean", "a live run has no first pass"),
        (TAKE + "--out x.xyz", "suffix '.xyz' given"),
        (TAKE + "--out nowhere/x.csv", "there is no folder nowhere"),
        (TAKE + "--out full.csv", "full.csv: is a folder"),
        (TAKE + "--out /proc/x.csv", "/proc/x.csv: cannot be written"),
        (TAKE + "--skeleton none.npz", "none.npz: no such file"),
        (TAKE + "--skeleton rig.toml", "rig.toml: holds no skeleton subject"),
        (TAKE + "--joints j.csv", "--joints j.csv: whose joints? give --skeleton"),
        (TAKE + "--rrd x.npz", "suffix '.npz' given; a recording for the Rerun viewer is an .rrd file"),
        (TAKE + "--rrd nowhere/x.rrd", "there is no folder nowhere"),
        (TAKE + "--record x.txt", "a record is a .json file"),
        (TAKE + "--record full.json", "full.json: is a folder"),
        (TAKE + "--record /proc/x.json", "/proc/x.json: cannot be written"),
    ],
)
def test_live(refused, given, told):
    assert told in refused("live " + given)


LEARN = "labels learn left.csv --out new.toml "


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ("zones --out new.csv left.csv", "1 file of tracks given; 2 or more"),
        ("zones --out new.csv left.csv left.csv", "a file is given twice"),
        ("zones --out new.csv left.csv none.csv", "none.csv: no such file"),
        ("zones --out new.csv left.csv bytes.csv", "bytes.csv"),
        ("zones --out new.csv left.csv rig.toml", "suffix '.toml' given"),
        ("zones --out new.csv left.csv full.csv", "full.csv"),
        ("zones --out new.csv left.csv bad.npz", "holds no tracks"),
        ("zones --out new.xyz left.csv right.csv", "suffix '.xyz' given"),
        ("zones --out nowhere/new.csv left.csv right.csv", "there is no folder nowhere"),
        ("zones --out full.csv left.csv right.csv", "full.csv: is a folder"),
        ("zones --out new.csv left.csv right.csv --fps nan", "nan is no finite number"),
        ("zones --out new.csv left.csv right.csv --fps 0", "0.0 is not in the range"),
        ("labels learn none.csv --out new.toml", "none.csv: no such file"),
        ("labels learn bytes.csv --out new.toml", "bytes.csv"),
        ("labels learn left.csv --out new.csv", "a marker model is a .toml file"),
        ("labels learn left.csv --out nowhere/new.toml", "there is no folder nowhere"),
        (LEARN, "no sample has a label; name its tracks with --name TRACK=LABEL"),
        (LEARN + "--name 9=A", "has no track 9; its tracks are 0, 1"),
        (LEARN + "--name A", "--name A: TRACK=LABEL is wanted"),
        (LEARN + "--name 0=A --name 0=B", "--name 0=B: track 0 has the name A already"),
        (LEARN + "--name 0=A --limb head", "mosca: --limb head: LIMB=LABEL,LABEL,... is wanted"),
        (LEARN + "--name 0=A --limb h=A,B --limb h=B,C", "limb 'h' is given twice"),
        (LEARN + "--name 0=A --name 1=B", "label three or more of its tracks"),
        (LEARN + "--frames 5:3", "FIRST:LAST is wanted"),
        ("labels apply left.csv --out new.csv --model none.toml", "none.toml: no such file"),
        ("labels apply left.csv --out new.csv --model rig.toml", "rig.toml: is a rig file, not a marker model"),
        ("labels apply left.csv --out new.xyz --model rig.toml", "suffix '.xyz' given"),
        ("labels auto left.csv --out new.csv --set helen", "set 'helen' given; it has plug-in-gait, cmu"),
        ("labels auto left.csv --out new.csv --set rig.toml", "rig.toml: is a rig file, not a marker template"),
        ("labels auto left.csv --out new.csv --model new.txt", "suffix '.txt' given; a marker model is a .toml file"),
        ("labels auto left.csv --out new.csv", "left.csv: no track can be named; z must be up"),
    ],
)
def test_zones_and_labels(refused, given, told):
    assert told in refused(given)


CONTINUOUS = "--continuous take --rig plain.toml --out new.csv "


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (CONTINUOUS + "--rate nan", "--rate nan"),
        (CONTINUOUS + "--rate 0", "--rate 0"),
        (CONTINUOUS + "--search -1", "--search -1"),
        (CONTINUOUS + "--clocks x", "'x' is not one of"),
        (CONTINUOUS + "--fps nan", "--fps nan"),
        (CONTINUOUS + "--lag 3", "--lag does not go with --continuous"),
        (CONTINUOUS + "--settings none.toml", "none.toml: no such file"),
        ("--continuous take --rig none.toml --out new.csv", "none.toml: no such file"),
        ("--continuous nope --rig plain.toml --out new.csv", "nope: no such folder"),
        ("--continuous take --rig plain.toml --out nowhere/new.csv", "no folder nowhere"),
        ("take --rig plain.toml --out new.csv --rate 3", "--rate does not go with a run without --continuous"),
        (
            CONTINUOUS + "--worn lamps.toml --clocks own",
            "--clocks does not go with --worn, whose cameras are of one clock",
        ),
        ("take --rig plain.toml --out new.csv --fill nan", "--fill nan"),
        ("take --rig plain.toml --out new.csv --fill 0", "--fill 0: the longest gap"),
        ("take --rig plain.toml --out new.csv --labels none.toml", "none.toml: no such file"),
        ("take --rig plain.toml --out new.csv --lag -3", "lag = -3 given"),
    ],
)
def test_reconstructing(refused, given, told):
    assert told in refused("reconstruct " + given)
