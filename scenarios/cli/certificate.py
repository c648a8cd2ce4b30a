"""The verb for certificates: certificate."""

import sys
from datetime import date, datetime
from pathlib import Path

import click

from mosca.errors import InputError
from scenarios.cli.claim import EXITS
from scenarios.cli.options import EXIT_BROKEN, EXIT_PASSED, FILE, OUT_FOLDER, echo_lines


@click.command()
@click.argument("results", nargs=-1, type=FILE)
@click.option("--out", type=OUT_FOLDER, default=Path("runs/certificate"), show_default=True, help="folder to write")
@click.option("--pdf", is_flag=True, help="also write certificate.pdf (needs the extra 'certificate')")
@click.option(
    "--title", default="Certificate of measurement performance", show_default=True, help="heading of the certificate"
)
@click.option("--customer", default="", help="customer that it is issued to")
@click.option("--issued", metavar="YYYY-MM-DD", help="date of issue  [default: today]")
@click.option(
    "--check",
    "checked",
    type=FILE,
    metavar="CERTIFICATE",
    help="report which files of this certificate changed since",
)
def certificate(
    results: tuple[Path, ...],
    out: Path,
    pdf: bool,
    title: str,
    customer: str,
    issued: str | None,
    checked: Path | None,
) -> None:
    """Write a certificate from results of acceptance tests, claims, budgets and runs, or check a certificate.

    RESULTS are the folders of these results. Of several results of the same subject the last counts, and the others
    are its history. Different subjects of one kind, such as two rigs, are shown side by side.

    Exit codes: 0 conforming, 1 not conforming, 3 undecided, 2 an input error; with --check 1 where a file changed or
    is missing.

    \b
    Example:  mosca certificate runs/acceptance/ball_bar runs/claims/quick_cloud --out runs/certificate --pdf
              mosca certificate --check runs/certificate
    """
    if checked is not None:
        if results:
            raise InputError(f"--check {checked}: checks a certificate that there is; leave {results[0]} out")
        _check(checked)
    from mosca.data.files.whole_file import check_folder, check_own_folder
    from reports.certificate.pdf import check_pdf
    from reports.certificate.words import conclusion
    from scenarios.studies.certificate.document import CertificateOptions, certificate_document
    from scenarios.studies.certificate.folder import RESULT, write_certificate
    from scenarios.studies.certificate.results import read_result

    check_own_folder(out, RESULT)
    check_folder(out)
    if pdf:
        check_pdf()
    options = CertificateOptions(title, customer, _day(issued))
    document = certificate_document([read_result(path) for path in results], options, out)
    click.echo(conclusion(document))
    written = write_certificate(document, out, pdf)
    echo_lines([str(path) for path in written])
    sys.exit(EXITS[document["verdict"]])


def _check(path: Path) -> None:
    from scenarios.studies.certificate.document import check_certificate, states_told, whole
    from scenarios.studies.certificate.folder import RESULT

    states = check_certificate(path / RESULT if path.is_dir() else path)
    echo_lines(states_told(states) or [f"{len(states)} files are as they were"])
    sys.exit(EXIT_PASSED if whole(states) == "conforming" else EXIT_BROKEN)


def _day(given: str | None) -> str:
    if given is None:
        return date.today().isoformat()
    try:
        return datetime.strptime(given, "%Y-%m-%d").date().isoformat()
    except ValueError:
        raise InputError(f"--issued {given}: a day as YYYY-MM-DD is wanted") from None
