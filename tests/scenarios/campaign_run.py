"""``mosca`` with its frame sets written down as the pipeline receives them: ``campaign_run.py SETS run ...``."""

import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from campaigns import shown

import mosca.pipeline
from mosca.data.frames import mid_exposure_ns

assemble = mosca.pipeline.assemble


def written(path, *given):
    with open(path, "w", encoding="utf-8") as file:
        for frame_set in assemble(*given):
            frames = {
                name: (*shown(frame.image), mid_exposure_ns(frame), frame.doubt)
                for name, frame in frame_set.frames.items()
            }
            file.write(json.dumps((frame_set.pulse, frame_set.time_ns, frames)) + "\n")
            yield frame_set


if __name__ == "__main__":
    from scenarios.cli.main import main

    path = sys.argv.pop(1)
    mosca.pipeline.assemble = lambda *given: written(path, *given)
    main()
