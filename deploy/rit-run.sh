#!/bin/sh
# rit-run.sh DIR EXPERIMENT [OPTION...]: begins the run of DIR, or goes on with the one that is there.
#
# What service managers call: they start the same command again after a reboot or a failure, and `rit train` never
# writes over a run. When it goes on, EXPERIMENT and options are not looked at: DIR/config.toml holds what was set.
set -eu
if [ "$#" -lt 2 ]; then
    echo "usage: rit-run.sh DIR EXPERIMENT [OPTION...]" >&2
    exit 2
fi
dir=$1
experiment=$2
shift 2
rit=${RIT:-rit}
if [ -e "$dir/config.toml" ]; then
    exec "$rit" train --resume "$dir"
fi
exec "$rit" train "$experiment" --run-dir "$dir" "$@"
