"""`python guard.py FOLDER`: shuts down the Redis server whose socket is in FOLDER once standard input closes.

Who uses the server holds the other end of that pipe: the server outlives them all and nobody else, however
they end. The standard library only: it waits as long as the server runs, and shall be small.
"""

import shutil
import signal
import socket
import sys


def main(folder: str) -> None:
    """Wait, then end the server; it writes everything to disk first."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # meant for those who use the server
    sys.stdin.buffer.read()
    with socket.socket(socket.AF_UNIX) as server:
        server.connect(f"{folder}/redis.sock")
        server.sendall(b"SHUTDOWN\r\n")
        server.recv(1)  # nothing, when it has ended
    shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main(sys.argv[1])
