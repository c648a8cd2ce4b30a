"""Entrants of the benchmark that are planted: they know the truth, or misbehave. Used by test_benchmark."""

import sys
from pathlib import Path

from scenarios.studies.benchmark.entrant import Entrant

BODIES = {
    # beside the data set lies the truth, which an honest entrant leaves alone
    "shifted": """
import csv, sys
from pathlib import Path
dataset, out = Path(sys.argv[2]), sys.argv[3]
rows = list(csv.DictReader(open(dataset.parent / "truth" / dataset.name / "points.csv")))
with open(out, "w") as file:
    file.write("frame,x,y,z\\n")
    for row in rows:
        file.write(f"{row['frame']},{row['x']},{row['y']},{float(row['z']) + 0.001!r}\\n")
""",
    "nothing": "import sys\nopen(sys.argv[3], 'w').write('frame,x,y,z\\n')\n",
    "slow": "import time\ntime.sleep(60)\n",
    "crash": "raise ValueError('the lens fell off')\n",
    "silent": "",
    "nonsense": "import sys\nopen(sys.argv[3], 'w').write('frame,x,y,z\\n99,0,0,0\\n')\n",
    "not_a_number": "import sys\nopen(sys.argv[3], 'w').write('frame,x,y,z\\n0,inf,0,0\\n')\n",
    "once": """
import sys
from pathlib import Path
seen = Path(sys.argv[2]).parent / "seen"
shift = 0.5 if seen.exists() else 0.25
seen.write_text("")
Path(sys.argv[3]).write_text(f"frame,x,y,z\\n0,{shift},0,0\\n")
""",
    "exact": """
import csv, sys
from pathlib import Path
phase, dataset, out = sys.argv[1], Path(sys.argv[2]), sys.argv[3]
truth = dataset.parent / "truth" / dataset.name
if phase == "detect":
    with open(out, "w") as file:
        file.write("camera,frame,u,v\\n")
        for row in csv.DictReader(open(truth / "images.csv")):
            if row["u"]:
                file.write(f"{row['camera']},{row['frame']},{row['u']},{row['v']}\\n")
else:
    targets = sorted({(int(r["frame"]), int(r["target"])) for r in csv.DictReader(open(sys.argv[5]))})
    names = list(dict.fromkeys(row["label"] for row in csv.DictReader(open(truth / "points.csv"))))
    points = {(r["frame"], r["label"]): r for r in csv.DictReader(open(truth / "points.csv"))}
    with open(out, "w") as file:
        file.write("frame,x,y,z\\n")
        for frame, target in targets:
            row = points[str(frame), names[target]]
            file.write(f"{frame},{row['x']},{row['y']},{row['z']}\\n")
""",
}


def planted(name: str, folder: Path, *tables: str) -> Entrant:
    """Write a planted adapter into ``folder`` and return its entrant, which runs in this environment."""
    path = folder / f"{name}.py"
    path.write_text(BODIES[name])
    return Entrant(name=name, title=name, adapter=str(path), tables=tables or ("images",))


PYTHON = Path(sys.executable)
