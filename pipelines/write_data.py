"""Write a generated scene set in a layout that other people's tools read: the Fraunhofer IPA dataset's, or BOP.

    make write-data OBJECT=gear ARGS="format=bop split=test"

Pictures are exact (no sensor noise). A set that is not generated yet is generated first. What is written for the same
scenes is not written again; an interrupted writing leaves nothing but a folder with a dot.
"""

from __future__ import annotations

from attentionvote.command.entry import command
from attentionvote.workflows.settings import WriteDataSettings
from attentionvote.workflows.write_data import run

if __name__ == "__main__":
    command(WriteDataSettings, run)
