"""Wrong inputs to every verb, through the command line: one line, exit code 2, and the folder is as it was."""

import pytest

KNOWN = "calibrate take --target wand.toml --out new.toml "
RUN = "run scene.toml --out new "
TRACKS = "reconstruct take --rig plain.toml --out new.csv "
FIND = "bodies find left.csv --out new.csv "


@pytest.mark.parametrize(
    ("given", "told"),
    [
        # a file in another one's place
        ("run rig.toml --out new", "rig.toml: is a rig file, not a scenario; a rig file goes to --rig"),
        ("run wand.toml --out new", "wand.toml: is a target file, not a scenario"),
        ("run background.toml --out new", "background.toml: is a settings file, not a scenario"),
        ("suite rig.toml --out new", "rig.toml: is a rig file, not a scenario"),
        ("live wand.toml", "wand.toml: is a target file, not a scenario"),
        ("twin serve wand.toml", "wand.toml: is a target file, not a scenario"),
        ("rig check scene.toml", "scene.toml: is a scenario, not a rig file; a scenario goes to mosca run"),
        ("rig check wand.toml", "wand.toml: is a target file, not a rig file"),
        ("rig compare plain.toml scene.toml", "scene.toml: is a scenario, not a rig file"),
        ("capture --rig scene.toml --out new", "scene.toml: is a scenario, not a rig file"),
        ("capture --rig wand.toml --out new", "wand.toml: is a target file, not a rig file"),
        ("capture --rig rig.toml --out new --program scene.toml", "scene.toml: is a scenario, not a program"),
        ("capture --rig rig.toml --out new --settings rig.toml", "rig.toml: is a rig file, not a settings file"),
        ("reconstruct take --rig scene.toml --out new.csv", "scene.toml: is a scenario, not a rig file"),
        ("reconstruct take --rig wand.toml --out new.csv", "wand.toml: is a target file, not a rig file"),
        (TRACKS + "--settings scene.toml", "scene.toml: is a scenario, not a settings file"),
        (TRACKS + "--labels rig.toml", "rig.toml: is a rig file, not a marker model"),
        (TRACKS + "--continuous --worn rig.toml", "rig.toml: is a rig file, not a lamp file"),
        ("calibrate take --target rig.toml --out new.toml", "rig.toml: is a rig file, not a target file"),
        ("calibrate take --target scene.toml --out new.toml", "scene.toml: is a scenario, not a target file"),
        (KNOWN + "--known scene.toml", "scene.toml: is a scenario, not a rig file"),
        ("target sheet scene.toml --out new.pdf", "scene.toml: is a scenario, not a target file"),
        (FIND + "--bodies wand.toml", "wand.toml: is a target file, not a bodies file"),
        ("labels apply left.csv --out new.csv --model scene.toml", "scene.toml: is a scenario, not a marker model"),
        ("labels coded take --rig scene.toml --out new.csv", "scene.toml: is a scenario, not a rig file"),
        # values
        (RUN + "--set limits.hota=98", "scene.toml: key 'limits.hota': 98 given; hota is a share above 0 to 1"),
        (RUN + "--set cameras.size_px=[0,0]", "'cameras.size_px[0]': 0 given; a number greater than 0 is wanted"),
        (RUN + "--set camera=[{name='x',size_px=[0,0]}]", "'camera[0].size_px[0]': 0 given"),
        (RUN + "--set scene.kind=clowd", "'scene.kind': 'clowd' given; one of 'actor',"),
        (RUN + "--set scene={markers=8}", "key 'scene.kind' is missing"),
        (RUN + "--set cameras.height_m=high", "'cameras.height_m': 'high' given; a number or a list in [ ] is"),
        (RUN + "--set title=5", "key 'title': 5 given; a text is wanted"),
        (RUN + "--set capture=5", "key 'capture': 5 given; a table is wanted"),
        (RUN + "--set pipeline.watch=often", "'pipeline.watch': 'often' given; true or false is wanted"),
        (RUN + "--set seed=1.5", "key 'seed': 1.5 given; a whole number is wanted"),
        (RUN + "--seed -1", "key 'seed': -1 given; a number greater than or equal to 0 is wanted"),
        (RUN + "--seed one", "'one' is not a valid integer"),
        (RUN + "--set capture.duration_s=nan", "nan given; a finite number is wanted"),
        (RUN + "--workers 0", "0 is not in the range"),
        (RUN + "--truth none.csv", "--truth none.csv: the twin has its own truth; leave --truth out"),
        ("run", "Missing argument 'SCENARIO'"),
        ("run empty.toml --out new", "empty.toml: key 'title' is missing"),
        ("suite none.toml --out new", "none.toml: no such file"),
        ("suite scene.toml --compare nope --out new --tier full", "nope: no such folder of baselines"),
        ("suite --compare full --update-baselines", "exclude each other"),
        ("suite --tier weekly", "'weekly' is not one of"),
        ("list here", "unexpected extra argument"),
        ("new rig.toml", "rig.toml: exists already"),
        ("new new.txt", "a scenario file ends in .toml"),
        ("new nowhere/new.toml", "no folder nowhere"),
        ("report full", "no such file; a run folder holds a record.json"),
        ("report scene.toml --out new.html", "scene.toml: not a run record"),
        ("view full", "full"),
        ("view none.rrd", "none.rrd"),
        ("rig check empty.toml", "empty.toml: key 'camera' is missing"),
        ("rig compare plain.toml none.toml", "none.toml: no such file"),
        ("rig compare plain.toml plain.toml --align some", "'some' is not one of"),
        ("rig convert plain.toml new.qca.txt", "a rig file ends in .toml; for another format give --format ("),
        ("rig convert full new.toml", "full"),
        ("rig convert plain.toml nowhere/new.yaml --format opencv", "nowhere"),
        (KNOWN + "--every 0", "0 is not in the range"),
        (KNOWN + "--lens pinhole", "'pinhole' is not one of"),
        (KNOWN + "--exterior-only", "--known RIG.toml"),
        (KNOWN + "--axes take plain.toml", "plain.toml: is a rig file, not a target file"),
        ("calibrate nope --target wand.toml --out new.toml", "nope: no such folder"),
        ("calibrate take --target none.toml --out new.toml", "none.toml: no such file"),
        ("calibrate take --target wand.toml --out new.csv", "new.csv: a rig file ends in .toml"),
        ("target sheet wand.toml --out new.pdf", "this target has no coded plates to print"),
        ("target sheet none.toml --out new.pdf", "none.toml: no such file"),
        ("target scale wand.toml", "give --ruler MEASURED PRINTED or --scan IMAGE DPI"),
        ("bodies learn left.csv --out new.toml --body drone", "NAME=TRACK"),
        ("bodies learn left.csv --out new.toml --body drone=0,9,1", "9"),
        (FIND + "--bodies none.toml", "none.toml: no such file"),
        ("labels blink left.csv --out new.csv --frames-per-bit 0", "0 is not in the range"),
        ("labels coded nope --rig plain.toml --out new.csv", "nope: no such folder"),
        ("motion convert none.bvh new.bvh", "none.bvh"),
        ("twin fidelity --out file.txt", "file.txt"),
        ("twin other", "No such command 'other'"),
        ("schema program", "'program' is not one of"),
        ("calibrat", "No such command 'calibrat'"),
    ],
)
def test_wrong_inputs(refused, given, told):
    line = refused(given)
    assert told in line
    for words in ("Input should", "Value error", "pydantic", "Traceback", "Errno"):
        assert words not in line
