"""Sizes on the command line."""

import re

import click


class Size(click.ParamType):
    """A size in pixels such as 640x480."""

    name = "WIDTHxHEIGHT"

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """(width, height), both positive."""
        match = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", value)
        if match is None:
            self.fail(f"'{value}' is no size such as 640x480", param, ctx)
        return int(match[1]), int(match[2])
