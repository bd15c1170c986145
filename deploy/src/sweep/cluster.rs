//! A sweep as jobs of a cluster: nothing is scheduled here. Each job runs one cell, by its index, and goes on with it when
//! it is started again.

use crate::failure::Failure;
use rit_config::{program_name, read_text};
use rit_record::Sweep;
use std::path::{Path, PathBuf};

/// What a cluster is told of a sweep.
#[derive(Debug)]
pub struct Job {
    /// The sweep's file.
    file: PathBuf,
    dir: PathBuf,
    cells: usize,
    /// How many run at once at most.
    at_once: Option<usize>,
    /// The queue of Kueue that it waits in.
    queue: Option<String>,
    /// Experiments that are files and no part of the program.
    experiments: Vec<PathBuf>,
    /// The sweep file's folder, as the experiments' paths begin with it.
    folder: PathBuf,
}

impl Job {
    /// Of this sweep.
    ///
    /// # Errors
    /// When its file has gone meanwhile.
    pub fn new(
        file: &Path,
        dir: &Path,
        sweep: &Sweep,
        at_once: Option<usize>,
        queue: Option<&str>,
    ) -> Result<Self, Failure> {
        let mut experiments: Vec<PathBuf> = sweep
            .cells
            .iter()
            .map(|cell| PathBuf::from(&cell.experiment))
            .filter(|path| path.extension().is_some_and(|extension| extension == "toml"))
            .collect();
        experiments.sort();
        experiments.dedup();
        // A name alone is of a file in the working directory.
        let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        Ok(Self {
            file: file.canonicalize().map_err(Failure::runtime)?,
            dir: dir.to_owned(),
            cells: sweep.cells.len(),
            at_once,
            queue: queue.map(str::to_owned),
            experiments,
            folder: std::path::absolute(folder).map_err(Failure::runtime)?,
        })
    }

    /// The sweep's name: its file's, as names of jobs may be.
    fn name(&self) -> String {
        let stem = self.file.file_stem().unwrap_or_default().to_string_lossy().to_lowercase();
        let plain: String =
            stem.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).take(40).collect();
        let words = plain.split('-').filter(|word| !word.is_empty()).collect::<Vec<_>>().join("-");
        if words.is_empty() { "sweep".to_owned() } else { words }
    }
}

/// Words of a shell, whatever they hold.
fn quoted(path: &Path) -> String {
    format!("'{}'", path.display().to_string().replace('\'', r"'\''"))
}

/// An array job for Slurm.
pub fn slurm(job: &Job) -> String {
    let Job { cells, at_once, .. } = job;
    let at_once = at_once.map_or_else(String::new, |at_once| format!("%{at_once}"));
    let (name, file, dir) = (job.name(), quoted(&job.file), quoted(&job.dir));
    let program = program_name();
    format!(
        r#"#!/bin/bash
# {cells} runs of a sweep, each by its index in the array: sbatch THIS-FILE. A job that is requeued, or started again, goes
# on with its run from the newest checkpoint; one whose run is finished ends at once. `{program} sweep status` in DIR shows how
# all stand. The folder lies on a file system that all nodes see and that can hold a Unix socket.
#SBATCH --job-name={name}
#SBATCH --array=0-{last}{at_once}
#SBATCH --requeue
#SBATCH --cpus-per-task=4
#SBATCH --mem=4G
#SBATCH --time=24:00:00
#SBATCH --signal=B:USR1@180
#SBATCH --open-mode=append
#SBATCH --output={name}-%A_%a.log
set -uo pipefail
rit=${{RIT:-{program}}}
file={file}
dir={dir}

# What shared memory is administered with needs a short path, and sites give long ones.
export TMPDIR=/tmp

"$rit" sweep "$file" --dir "$dir" --cell "$SLURM_ARRAY_TASK_ID" &
run=$!
# Three minutes before the job's time is over: a checkpoint, and into the queue again. A job that is cancelled or preempted
# gets TERM and writes its checkpoint too; whether it comes back is Slurm's to decide.
again=false
trap 'again=true; kill -TERM "$run" 2>/dev/null' USR1
trap 'kill -TERM "$run" 2>/dev/null' TERM INT

# `wait` returns early when a trap has run: wait until the run has really ended.
status=0
while kill -0 "$run" 2>/dev/null; do
    status=0
    wait "$run" || status=$?
done
if [ "$status" -eq 130 ] && "$again"; then
    exec scontrol requeue "${{SLURM_ARRAY_JOB_ID}}_${{SLURM_ARRAY_TASK_ID}}"
fi
exit "$status"
"#,
        last = cells - 1,
    )
}

/// A text as a value of a ConfigMap, under its key.
fn value(key: &str, path: &Path) -> Result<String, Failure> {
    let text =
        read_text(path).map_err(|error| Failure::input_message(format!("{}: {error}", path.display())))?;
    let line = |line: &str| if line.is_empty() { "\n".to_owned() } else { format!("    {line}\n") };
    // By how much lines are indented is said: a first line that is itself indented would say more.
    Ok(format!("  {key}: |2\n{}", text.lines().map(line).collect::<String>()))
}

/// Experiments that are files: their values in the ConfigMap, and where each comes to lie beside the sweep's file.
fn experiment_files(job: &Job) -> Result<(String, String), Failure> {
    let (mut values, mut places) = (String::new(), String::new());
    for (at, path) in job.experiments.iter().enumerate() {
        let inside = path
            .strip_prefix(&job.folder)
            .ok()
            .filter(|inside| inside.components().all(|part| matches!(part, std::path::Component::Normal(_))));
        let Some(inside) = inside.and_then(Path::to_str) else {
            return Err(Failure::input_message(format!(
                "{}: a pod gets the experiments that come with the program, and files in the folder of the sweep's file or \
                 below it; put this one there",
                path.display()
            )));
        };
        let key = format!("experiment-{at}.toml");
        values += &value(&key, path)?;
        places += &format!("\n              - {{ key: {key}, path: {inside:?} }}");
    }
    Ok((values, places))
}

/// An Indexed Job for Kubernetes, with the sweep's file, and experiments that are files, in a ConfigMap.
///
/// # Errors
/// When the sweep's file cannot be read any more, or names experiments that lie elsewhere.
pub fn kubernetes(job: &Job) -> Result<String, Failure> {
    let text = value("sweep.toml", &job.file)?;
    let (experiments, places) = experiment_files(job)?;
    let (name, cells) = (job.name(), job.cells);
    let at_once = job.at_once.unwrap_or(cells);
    let (queue, suspend) = match &job.queue {
        Some(queue) => (format!("\n    kueue.x-k8s.io/queue-name: {queue}"), true),
        None => (String::new(), false),
    };
    Ok(format!(
        include_str!("kubernetes.template.yaml"),
        at_once = at_once,
        cells = cells,
        experiments = experiments,
        name = name,
        places = places,
        program = program_name(),
        queue = queue,
        suspend = suspend,
        text = text,
        version = env!("CARGO_PKG_VERSION"),
    ))
}
