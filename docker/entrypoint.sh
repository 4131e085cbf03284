#!/bin/bash
# SPDX-License-Identifier: Apache-2.0
# Becomes the command, in the environment of the image.
set -e
source /environment.sh
exec "$@"
