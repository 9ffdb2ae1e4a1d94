"""`jaxmarine` and `python -m jaxmarine`: the command line, or one sentence where its packages are missing."""

import sys

from ._extras import MissingExtra


def main() -> None:
    try:
        from .cli import main as run
    except MissingExtra as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    run()


if __name__ == "__main__":
    main()
