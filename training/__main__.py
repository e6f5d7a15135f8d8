"""`python -m training` is the `pointflownet` command; torchrun starts it so."""

from training.cli import main

main()
