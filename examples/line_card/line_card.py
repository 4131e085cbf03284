# SPDX-License-Identifier: Apache-2.0
"""
A backend for a card that takes lines of text over TCP: a microcontroller with converters, say.

Every line is answered by one: ``read`` by the volts of all inputs, ``reload`` by ``ok`` or
``expired``, all others by ``ok``; anything else is the card's complaint. ``safe`` names the
watchdog's time in s and the volts that the card puts out when it runs out: that it does so by
itself, without this computer, is what makes it a card that may drive a rig.
"""

import socket

from fam_bundle_io.hardware.backend import BackendError, Card, Volts
from fam_bundle_model.schema import ConfigurationError
import numpy as np


class LineCard(Card):
    """See ``fam_bundle_io.hardware.backend.Backend``; options ``host`` and ``port``."""

    def _open(self) -> None:
        host, port = self.setup.options.get('host'), self.setup.options.get('port')
        if not isinstance(host, str) or not isinstance(port, int):
            raise ConfigurationError(
                f'backends.line_card = {dict(self.setup.options)}: must hold host and port'
            )
        try:
            self._line = socket.create_connection((host, port), self.setup.read_timeout)
        except OSError as error:
            raise BackendError(error.errno or 0, f'{host}:{port}: {error.strerror}') from error
        # Small lines at once: waiting for more to send would cost tens of milliseconds.
        self._line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._answers = self._line.makefile('r')
        self._tell('safe', self.setup.watchdog_timeout, *self.setup.safe_volts)

    def _start_watchdog(self) -> None:
        self._tell('arm')

    def _read(self, volts: Volts) -> None:
        values = np.array(self._ask('read').split(), dtype=np.float64)
        np.copyto(volts, values[self.setup.inputs])

    def _write(self, volts: Volts) -> None:
        self._tell('write', *volts)

    def _reload(self) -> bool:
        return self._ask('reload') == 'ok'

    def _stop_watchdog(self) -> None:
        self._tell('stop')

    def _let_go(self) -> None:
        if hasattr(self, '_line'):
            self._answers.close()
            self._line.close()

    def _tell(self, word: str, *values: float) -> None:
        answer = self._ask(word, *values)
        if answer != 'ok':
            raise BackendError(0, f'{word}: {answer}')

    def _ask(self, word: str, *values: float) -> str:
        line = ' '.join([word, *(repr(float(value)) for value in values)])
        try:
            self._line.sendall(f'{line}\n'.encode())
            answer = self._answers.readline()
        except OSError as error:
            raise BackendError(error.errno or 0, f'{word}: {error}') from error
        if not answer:
            raise BackendError(0, f'{word}: the card has hung up')
        return answer.strip()
