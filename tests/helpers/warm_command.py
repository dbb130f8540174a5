"""The command `salver` without the second that a new process spends on loading libraries: for pages that call it often.

`command(folder)` puts a program `salver` into a folder. It hands its arguments, directory, environment and standard
files to a server that has loaded what the commands need, and that forks: what runs is `salver.cli.main`, alone in a
process of its own. Standard library only, so that the program itself starts at once.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

CLIENT = """#!{python} -IS
import json, os, socket, sys
server = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
server.connect({address!r})
call = json.dumps([sys.argv[1:], os.getcwd(), dict(os.environ)]).encode()
socket.send_fds(server, [call], [0, 1, 2])
sys.exit((server.recv(1) or b"\\x01")[0])
"""


@contextmanager
def command(folder: Path) -> Iterator[Path]:
    """The folder, with the program in it, while the server runs."""
    address = str(folder / "socket")
    program = folder / "salver"
    program.write_text(CLIENT.format(python=sys.executable, address=address))
    program.chmod(0o755)
    server = subprocess.Popen([sys.executable, __file__, address])
    try:
        while not Path(address).exists():
            assert server.poll() is None
            time.sleep(0.02)
        yield folder
    finally:
        server.terminate()
        server.wait()


# What most commands need; each is loaded by the command that needs it otherwise.
LOADED = ("salver.planning.make", "salver.simulation.physics", "matplotlib.pyplot", "arro3.io", "scipy.stats")


def serve(address: str) -> None:
    from salver.cli import main

    for name in LOADED:
        importlib.import_module(name)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listening.bind(address)
    listening.listen()
    while True:
        connection, _ = listening.accept()
        if os.fork() == 0:
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            call, files, *_ = socket.recv_fds(connection, 1 << 20, 3)
            arguments, directory, environment = json.loads(call)
            for number, file in enumerate(files):
                os.dup2(file, number)
            os.chdir(directory)
            os.environ.update(environment)
            sys.argv = ["salver", *arguments]
            code = 1
            try:
                main()
                code = 0
            except SystemExit as end:
                code = end.code if isinstance(end.code, int) else int(end.code is not None)
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                connection.send(bytes([code]))
            sys.exit(code)
        connection.close()


if __name__ == "__main__":
    serve(sys.argv[1])
