"""`python -m hylios_fit` is `hylios-fit`."""

from hylios_fit.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
