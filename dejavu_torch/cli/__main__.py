"""`python -m dejavu_torch.cli` is the `dejavu` command."""

from dejavu_torch.cli import main

main()
