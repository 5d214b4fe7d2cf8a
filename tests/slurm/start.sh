#!/usr/bin/env bash
# A small Slurm cluster on this machine, for tests: munge, one controller, a few compute daemons, all on loopback.
#
#   tests/slurm/start.sh FOLDER         start it; keeps its state, logs and process numbers in FOLDER
#   tests/slurm/start.sh FOLDER stop    stop it and take its configuration away
#
# Needs root, and Debian's packages munge, slurmctld, slurmd and slurm-client (installed here where apt-get is there).
# Exit status: 0 done; 3 it cannot be had on this machine, with the reason on standard error.
# Knobs: SLURM_TEST_NODES (2), SLURM_TEST_CPUS (2) and SLURM_TEST_MEMORY in MB (8000), each of one compute daemon.
set -euo pipefail

folder=${1:?folder of the cluster}
configuration=/etc/slurm/slurm.conf # Snakemake's plugin drops SLURM_CONF from the environment: only this place is seen
nodes=${SLURM_TEST_NODES:-2} cpus=${SLURM_TEST_CPUS:-2} memory=${SLURM_TEST_MEMORY:-8000}

cannot() {
    echo "$1" >&2
    exit 3
}

# Slurm's commands wait for minutes where nobody answers.
quickly() { timeout 10 "$@"; }

until_true() { # seconds command...
    local end=$((SECONDS + $1))
    shift
    until "$@" >/dev/null 2>&1; do
        [ "$SECONDS" -lt "$end" ] || return 1
        sleep 0.1
    done
}

stop() {
    [ -d "$folder" ] || return 0
    quickly scancel --user=root 2>/dev/null || true
    local file pid
    for file in "$folder"/run/*.pid; do
        [ -s "$file" ] || continue
        pid=$(cat "$file")
        kill "$pid" 2>/dev/null || true
        until_true 5 gone "$pid" || kill -9 "$pid" 2>/dev/null || true
        rm -f "$file"
    done
    # A configuration without a controller makes every command of Slurm, and each start of Snakemake with the plugin, wait.
    [ "$(readlink "$configuration" 2>/dev/null)" != "$folder/slurm.conf" ] || rm -f "$configuration"
}

gone() { ! kill -0 "$1" 2>/dev/null; }

packages() {
    local package missing=()
    for package in munge slurmctld slurmd slurm-client; do
        dpkg-query -W -f='${Status}' "$package" 2>/dev/null | grep -q 'install ok installed' || missing+=("$package")
    done
    [ "${#missing[@]}" -gt 0 ] || return 0
    command -v apt-get >/dev/null || cannot "Slurm is not installed and there is no apt-get to install it"
    export DEBIAN_FRONTEND=noninteractive
    { apt-get -qq update && apt-get -qq -y install --no-install-recommends "${missing[@]}"; } >"$folder/log/apt" 2>&1 ||
        cannot "apt-get install ${missing[*]} failed: $(tail -n 1 "$folder/log/apt")"
}

authenticated() { munge -n | unmunge; }

munge_daemon() {
    ! authenticated >/dev/null 2>&1 || return 0 # the machine has its own: it stays
    [ -s /etc/munge/munge.key ] || cannot "/etc/munge/munge.key is missing: dpkg-reconfigure munge makes it"
    install -d -o munge -g munge -m 0755 /run/munge
    rm -f /run/munge/munge.socket.2*
    runuser -u munge -- munged || cannot "munged does not start"
    until_true 10 authenticated || cannot "munged does not answer"
    cp /run/munge/munged.pid "$folder/run/munged.pid"
}

configure() {
    local host node
    host=$(hostname -s)
    cat <<END
ClusterName=nishiki-test
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=26717
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
CredType=cred/munge
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
MpiDefault=none
SwitchType=switch/none
TaskPlugin=task/none
# No cgroups in a container: processes are found by parent, and memory is looked at every second.
ProctrackType=proctrack/linuxproc
JobAcctGatherType=jobacct_gather/linux
JobAcctGatherFrequency=task=1
JobAcctGatherParams=OverMemoryKill
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SchedulerParameters=sched_interval=1,bf_interval=1
AccountingStorageType=accounting_storage/none
# A line for each job that ended.
JobCompType=jobcomp/filetxt
JobCompLoc=$folder/log/jobs
ReturnToService=2
KillWait=3
MinJobAge=300
LaunchParameters=disable_send_gids
StateSaveLocation=$folder/state
SlurmctldPidFile=$folder/run/slurmctld.pid
SlurmctldLogFile=$folder/log/slurmctld
SlurmdPidFile=$folder/run/%n.pid
SlurmdSpoolDir=$folder/spool-%n
SlurmdLogFile=$folder/log/%n
END
    for node in $(seq "$nodes"); do
        echo "NodeName=test$node NodeHostname=$host NodeAddr=127.0.0.1 Port=$((26720 + node)) CPUs=$cpus RealMemory=$memory"
    done
    echo "PartitionName=main Nodes=test[1-$nodes] Default=YES MaxTime=120 DefMemPerCPU=500 State=UP"
}

# Whether this machine has a Slurm that is not ours, or one of ours that runs; what a dead one of ours left is no hindrance.
occupied() {
    [ -e "$configuration" ] || return 1
    grep -qx "ClusterName=nishiki-test" "$configuration" || return 0
    quickly scontrol ping 2>/dev/null | grep -q "is UP"
}

all_idle() { [ "$(quickly sinfo -h -N -t idle -o %N | sort -u | wc -l)" = "$nodes" ]; }

start() {
    [ "$(id -u)" = 0 ] || cannot "a test cluster needs root"
    ! occupied || cannot "this machine has a Slurm already ($configuration)"
    mkdir -p "$folder"/{state,run,log}
    packages
    munge_daemon
    configure >"$folder/slurm.conf"
    ln -sf "$folder/slurm.conf" "$configuration"
    local node
    slurmctld || cannot "slurmctld does not start: $(tail -n 1 "$folder/log/slurmctld")"
    for node in $(seq "$nodes"); do
        mkdir -p "$folder/spool-test$node"
        slurmd -N "test$node" || cannot "slurmd does not start: $(tail -n 1 "$folder/log/test$node")"
    done
    until_true 30 all_idle || cannot "the compute daemons do not become idle: $(tail -n 1 "$folder/log/slurmctld")"
}

folder=$(mkdir -p "$folder" && cd "$folder" && pwd)
case ${2:-start} in
    start)
        trap '[ $? = 0 ] || stop' EXIT
        start
        ;;
    stop) stop ;;
    *) echo "start.sh FOLDER [start | stop]" >&2; exit 2 ;;
esac
