"""Processes of Python in which torch, or more, is imported already, which takes seconds: they are forked from
one that has done so and nothing else, and are as if started anew."""

from __future__ import annotations

import atexit
import json
import os
import socket
import subprocess
import sys
from functools import cache
from threading import Lock
from typing import Any

TORCH, PACKAGE = "torch", "dejavu_torch.cli.reports"
SERVER = """
import importlib, json, os, socket, sys
importlib.import_module(sys.argv[1])
with socket.socket(fileno=os.dup(0)) as asked:
    while True:
        said, streams, _, _ = socket.recv_fds(asked, 2**20, 3)
        told = json.loads(said or "0")
        if not told:
            os._exit(0)
        elif "wait" in told:
            asked.send(json.dumps(os.waitpid(*told["wait"])).encode())
        elif child := os.fork():
            [os.close(stream) for stream in streams]
            asked.send(json.dumps(child).encode())
        else:
            break
for number, stream in enumerate(streams):
    os.dup2(stream, number)
    os.close(stream)
os.chdir(told["folder"])
os.environ.clear()
os.environ.update(told["environment"])
sys.argv[1:] = told["words"]
exec(compile(told["code"], "<string>", "exec"), {"__name__": "__main__"})
"""


class Asked:
    """The process that is forked, by a socket."""

    def __init__(self, imports: str) -> None:
        self.lock = Lock()
        self.socket, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        if imports == TORCH:
            self.process = subprocess.Popen([sys.executable, "-c", SERVER, imports], stdin=there)
        else:
            self.process = Forked(SERVER, imports, stdin=there)
        there.close()
        atexit.register(self.end)

    def ask(self, question, streams=()):
        with self.lock:
            socket.send_fds(self.socket, [json.dumps(question).encode()], streams)
            return json.loads(self.socket.recv(100))

    def end(self):
        self.socket.close()
        self.process.wait()


asked = cache(Asked)


class Forked(subprocess.Popen[Any]):
    """A process that runs code as `python -c CODE WORDS` does."""

    def __init__(self, code: str, *words: object, imports: str = TORCH, **settings: Any) -> None:
        self.asked = asked(imports)
        super().__init__([code, *map(str, words)], **settings)

    def _execute_child(self, args, *given):
        folder, environment = given[4:6]
        question = {"code": args[0], "words": args[1:], "folder": str(folder or os.getcwd())}
        question |= {"environment": dict(os.environ if environment is None else environment)}
        pipes = [(given[9], given[10]), (given[12], given[11]), (given[14], given[13])]  # its end, ours
        self.pid = self.asked.ask(question, tuple(i if it == -1 else it for i, (it, _) in enumerate(pipes)))
        for it, ours in pipes:
            if -1 not in (it, ours):
                os.close(it)

    def _try_wait(self, flags):
        return self.asked.ask({"wait": [self.pid, flags]})

    def _internal_poll(self, *_):
        if self.returncode is None:
            pid, status = self._try_wait(os.WNOHANG)
            if pid:
                self._handle_exitstatus(status)
        return self.returncode


def python(code, *words, input=None, **settings):
    """What such a process ends with and has printed."""
    settings = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, **settings}
    with Forked(code, *words, stdin=None if input is None else subprocess.PIPE, **settings) as process:
        printed = process.communicate(input)
    return subprocess.CompletedProcess(words, process.returncode, *printed)
