"""`python -m jaxcal.cli`: the command where its script is not on the path."""

from jaxcal.cli import main

main(prog_name="jaxcal")
