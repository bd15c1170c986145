//! `rit sweep`: real cells, side by side, through everything that may happen to them.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests are tests too")]

mod common;

use common::{output, refused, rit};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use std::{
    fs,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};
use tempfile::TempDir;

/// Far beyond what any step takes: reached only when something hangs.
const DEADLINE: Duration = Duration::from_secs(120);

/// Two methods of small networks, whose cells take a second or two.
const SWEEP: &str = r#"
experiment = "matrix-game"
seeds = [1, 2]
[axes]
"algorithm.name" = ["rit", "vdn-attn"]
[set]
"training.t_max" = 400
"network.hidden_dim" = 8
"evaluation.episodes" = 2
"evaluation.every_env_steps" = 100
"checkpoints.every_env_steps" = 100
"#;

struct Sweep {
    folder: TempDir,
}

impl Sweep {
    fn new(text: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("two methods.toml"), text).unwrap();
        Self { folder }
    }

    fn file(&self) -> PathBuf {
        self.folder.path().join("two methods.toml")
    }

    fn dir(&self) -> PathBuf {
        self.folder.path().join("sweep")
    }

    fn arguments<'a>(&self, more: &[&'a str]) -> Vec<String> {
        let (file, dir) = (self.file().display().to_string(), self.dir().display().to_string());
        let own = ["sweep".to_owned(), file, "--dir".to_owned(), dir];
        own.into_iter().chain(more.iter().map(|&it: &&'a str| it.to_owned())).collect()
    }

    fn command(&self, more: &[&str]) -> Command {
        let arguments = self.arguments(more);
        rit(&arguments.iter().map(String::as_str).collect::<Vec<_>>())
    }

    /// Runs it; its exit code, what it prints as JSON, and what it says.
    fn run(&self, more: &[&str]) -> (Option<i32>, Value, String) {
        let output = self.command(&[&["--json"], more].concat()).output().unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        let answer = serde_json::from_slice(&output.stdout).unwrap_or(Value::Null);
        (output.status.code(), answer, stderr)
    }

    fn status(&self) -> Value {
        let output = output(&["sweep", "status", self.dir().to_str().unwrap(), "--json"]);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        serde_json::from_slice(&output.stdout).unwrap()
    }

    fn summary(&self, cell: &str) -> Value {
        let path = self.dir().join("runs").join(cell).join("summary.json");
        serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
    }

    /// Waits until so many cells of it train.
    fn wait_for_running(&self, sweep: &mut Child, count: u64) {
        let begun = Instant::now();
        while !self.dir().join("sweep.json").exists()
            || self.status()["counts"]["running"].as_u64() < Some(count)
        {
            assert!(sweep.try_wait().unwrap().is_none() && begun.elapsed() < DEADLINE, "none runs");
            std::thread::yield_now();
        }
    }

    /// Waits until nothing trains any more.
    fn wait_until_quiet(&self) {
        let begun = Instant::now();
        while self.status()["counts"]["running"] != 0 {
            assert!(begun.elapsed() < DEADLINE, "{}", self.status());
            std::thread::yield_now();
        }
    }
}

/// The weights of the same run without a sweep.
fn digest_alone(settings: &[&str]) -> Value {
    let folder = common::RunFolder::new();
    let sets = ["network.hidden_dim=8", "evaluation.episodes=2"];
    let sets = settings.iter().chain(&sets).flat_map(|setting| ["--set", setting]);
    folder.train(&[&["matrix-game"], &sets.collect::<Vec<_>>()[..]].concat())["weights_digest"].clone()
}

#[test]
fn every_cell_is_run_once_and_is_the_run_that_it_would_be_alone() {
    let sweep = Sweep::new(SWEEP);
    let (code, planned, _) = sweep.run(&["--dry-run"]);
    assert_eq!((code, &planned["counts"]["waiting"]), (Some(0), &4.into()));
    assert!(!sweep.dir().exists(), "a dry run makes nothing");
    let (code, done, stderr) = sweep.run(&["--jobs", "2"]);
    assert_eq!((code, &done["counts"]["finished"]), (Some(0), &4.into()), "{stderr}");
    let names = ["rit_seed-1", "vdn-attn_seed-1", "rit_seed-2", "vdn-attn_seed-2"];
    for (cell, name) in done["cells"].as_array().unwrap().iter().zip(names) {
        assert_eq!((&cell["cell"], &cell["env_steps"]), (&name.into(), &400.into()));
        assert!(cell["cpu_s"].as_f64() > Some(0.0) && cell["win_rate"].is_number(), "{cell}");
    }
    let alone = digest_alone(&["seed=2", "algorithm.name=vdn-attn", "training.t_max=400"]);
    assert_eq!(sweep.summary("vdn-attn_seed-2")["weights_digest"], alone);

    // Small records of them.
    let records = sweep.folder.path().join("records");
    for expected in ["4 new records, 0 were there; 0 cells", "0 new records, 4 were there; 0 cells"] {
        let (dir, records) = (sweep.dir(), records.display().to_string());
        let said = output(&["sweep", "collect", dir.to_str().unwrap(), "--out", &records]);
        assert!(String::from_utf8_lossy(&said.stdout).contains(expected), "{said:?}");
    }
    let record = rit_record::Record::read(&records.join("rit_seed-2.jsonl")).unwrap();
    assert_eq!((record.seed, record.method(), record.training.len()), (Some(2), Some("rit"), 0));
    assert_eq!(record.weights_digest.as_deref(), sweep.summary("rit_seed-2")["weights_digest"].as_str());

    // Nothing is run again, and a further seed is run alone.
    let before = fs::metadata(sweep.dir().join("runs/rit_seed-1/summary.json")).unwrap().modified().unwrap();
    fs::write(sweep.file(), SWEEP.replace("[1, 2]", "[1, 2, 3]")).unwrap();
    let (_, planned, _) = sweep.run(&["--dry-run"]);
    let left = planned["cells"][4]["cpu_left_s"].as_f64().unwrap();
    let taken = ["rit_seed-1", "rit_seed-2"].map(|cell| sweep.summary(cell)["cpu_s"].as_f64().unwrap());
    assert!((left - (taken[0] + taken[1]) / 2.0).abs() < 1e-9, "{left} of {taken:?}");
    let (code, done, _) = sweep.run(&["--jobs", "2"]);
    assert_eq!((code, &done["counts"]["finished"]), (Some(0), &6.into()));
    let after = fs::metadata(sweep.dir().join("runs/rit_seed-1/summary.json")).unwrap().modified().unwrap();
    assert_eq!(before, after);
    let printed = output(&["sweep", "status", sweep.dir().to_str().unwrap()]);
    let text = String::from_utf8(printed.stdout).unwrap();
    assert!(text.starts_with("cell ") && text.ends_with("6 cells: 6 finished\n"), "{text}");

    // What the file does not have any more is not thrown away.
    fs::write(sweep.file(), SWEEP.replace("[1, 2]", "[1]")).unwrap();
    let (code, _, stderr) = sweep.run(&[]);
    assert!(
        code == Some(2) && stderr.contains("holds another sweep: its cell rit_seed-2 is not in"),
        "{stderr}"
    );
}

#[test]
fn a_cell_that_fails_is_reported_and_the_others_go_on() {
    let failing = "[[override]]\nwhere = { \"algorithm.name\" = \"rit\", seed = 1 }\n\
                   set = { \"learner.listen\" = \"tcp:127.0.0.1:0\", \"learner.token_file\" = \"/nowhere/token\" }\n";
    let sweep = Sweep::new(&format!("{SWEEP}{failing}"));
    let (code, done, stderr) = sweep.run(&["--jobs", "1"]);
    assert_eq!((code, &done["counts"]["finished"]), (Some(1), &3.into()), "{stderr}");
    assert!(stderr.contains("rit_seed-1: ") && stderr.contains("/nowhere/token"), "{stderr}");
    let (code, _, _) = sweep.run(&["--cell", "0"]);
    let failed = &sweep.status()["cells"][0];
    assert_eq!((code, &failed["state"]), (Some(2), &"failed".into()), "a job of a cluster says so too");
    assert!(failed["reason"].as_str().unwrap().contains("/nowhere/token"), "{failed}");
}

#[test]
fn a_cell_whose_process_cannot_be_started_ends_no_other() {
    let sweep = Sweep::new(&SWEEP.replace("[1, 2]", "[1]"));
    let script = sweep.folder.path().join("job.sbatch");
    assert!(sweep.command(&["--slurm", script.to_str().unwrap()]).status().unwrap().success());
    // A folder where the first cell's log should lie.
    let log = sweep.dir().join("logs/rit_seed-1.log");
    fs::create_dir_all(&log).unwrap();
    let (code, done, stderr) = sweep.run(&["--jobs", "2"]);
    assert_eq!((code, &done["counts"]["finished"]), (Some(1), &1.into()), "{stderr}");
    assert!(stderr.contains("rit_seed-1: its process could not be started"), "{stderr}");
    fs::remove_dir(&log).unwrap();
    let (code, done, stderr) = sweep.run(&["--jobs", "2"]);
    assert_eq!((code, &done["counts"]["finished"]), (Some(0), &2.into()), "{stderr}");
}

#[test]
fn an_interrupted_sweep_goes_on_to_the_same_weights() {
    let text = SWEEP.replace("= 400", "= 2500").replace("[1, 2]", "[1]");
    let sweep = Sweep::new(&text);
    let mut child =
        sweep.command(&["--jobs", "2"]).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    sweep.wait_for_running(&mut child, 2);
    let (code, _, stderr) = sweep.run(&[]);
    assert!(code == Some(2) && stderr.contains("another `rit sweep` runs in"), "{stderr}");
    kill_process(Pid::from_raw(child.id() as i32).unwrap(), Signal::TERM).unwrap();
    let ended = child.wait_with_output().unwrap();
    let stderr = String::from_utf8_lossy(&ended.stderr);
    assert_eq!(ended.status.code(), Some(130), "{stderr}");
    assert_eq!(sweep.summary("rit_seed-1")["ended"], "interrupted", "{stderr}");

    // And once more, killed this time: its runs end with it.
    let mut child =
        sweep.command(&["--jobs", "2"]).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    sweep.wait_for_running(&mut child, 2);
    child.kill().unwrap();
    child.wait().unwrap();
    sweep.wait_until_quiet();
    let (code, done, stderr) = sweep.run(&["--jobs", "2"]);
    assert_eq!((code, &done["counts"]["finished"]), (Some(0), &2.into()), "{stderr}");
    let alone = digest_alone(&["seed=1", "algorithm.name=vdn-attn", "training.t_max=2500"]);
    assert_eq!(sweep.summary("vdn-attn_seed-1")["weights_digest"], alone);
}

/// ROMA with the largest learning rate there is diverges in its second update (`divergence.rs`).
#[test]
fn a_cell_that_has_diverged_is_not_tried_again_but_with_retry() {
    let text = "experiment = \"matrix-game\"\nseeds = [3]\n[set]\n\"algorithm.name\" = \"roma\"\n\"algorithm.lr\" = 1.0\n\
                \"training.t_max\" = 2000\n\"evaluation.episodes\" = 1\n\"checkpoints.every_env_steps\" = 8\n";
    let sweep = Sweep::new(text);
    let (code, done, stderr) = sweep.run(&[]);
    assert_eq!((code, &done["counts"]["diverged"]), (Some(1), &1.into()), "{stderr}");
    let written = || fs::metadata(sweep.dir().join("runs/seed-3/summary.json")).unwrap().modified().unwrap();
    let before = written();
    let (code, _, stderr) = sweep.run(&[]);
    assert!(
        code == Some(1) && stderr.contains("seed-3: left alone") && stderr.contains("--retry"),
        "{stderr}"
    );
    let (code, _, stderr) = sweep.run(&["--cell", "0"]);
    assert!(code == Some(1) && stderr.contains("--retry tries again"), "{stderr}");
    assert_eq!(before, written(), "nothing was run");
    let (code, _, stderr) = sweep.run(&["--retry"]);
    assert!(code == Some(1) && before < written(), "{stderr}");
}

/// On a file system that several hosts share.
#[test]
fn a_cell_that_another_host_trained_last_is_unknown() {
    let sweep = Sweep::new(&SWEEP.replace("[1, 2]", "[1]"));
    assert_eq!(sweep.run(&["--jobs", "1"]).0, Some(0));
    let run_dir = sweep.dir().join("runs/rit_seed-1");
    fs::remove_file(run_dir.join("summary.json")).unwrap();
    fs::write(run_dir.join("lock"), "1 elsewhere\n").unwrap();
    let cell = &sweep.status()["cells"][0];
    assert_eq!(cell["state"], "unknown");
    assert_eq!(cell["reason"], "it is, or was killed, on another host, elsewhere");
}

#[test]
fn what_is_wrong_is_said_and_nothing_is_made() {
    let sweep = Sweep::new(SWEEP);
    let (file, dir) = (sweep.file().display().to_string(), sweep.dir().display().to_string());
    refused(&["sweep"], &["give a sweep's file"]);
    refused(&["sweep", &file], &["give --dir DIR"]);
    refused(&["sweep", &file, "--dir", &dir, "--cell", "4"], &["--cell 4: the sweep's cells are 0 to 3"]);
    refused(&["sweep", "nowhere.toml", "--dir", &dir], &["nowhere.toml: No such file"]);
    fs::remove_dir_all(&dir).unwrap();
    for (from, to, message) in [
        ("network.hidden_dim", "network.hiden_dim", "did you mean network.hidden_dim?"),
        ("[\"rit\", \"vdn-attn\"]", "[]", "the axis algorithm.name has no values"),
        ("[1, 2]", "[1, 1]", "the seed 1 is there twice"),
        ("seeds", "sedes", "unknown field `sedes`"),
    ] {
        fs::write(&file, SWEEP.replace(from, to)).unwrap();
        refused(&["sweep", &file, "--dir", &dir], &[message]);
        assert!(!Path::new(&dir).exists());
    }
    fs::write(&file, SWEEP).unwrap();
    fs::create_dir(&dir).unwrap();
    refused(&["sweep", "status", &dir], &["holds no sweep"]);
    fs::write(Path::new(&dir).join("thesis.tex"), "").unwrap();
    refused(
        &["sweep", &file, "--dir", &dir],
        &["holds something else than a sweep, \"thesis.tex\" lies there"],
    );
}

#[test]
fn a_job_of_an_array_runs_its_cell_and_goes_on_with_it() {
    let sweep = Sweep::new(&SWEEP.replace("[1, 2]", "[1]"));
    let script = sweep.folder.path().join("it's an array.sbatch");
    let written = sweep.command(&["--jobs", "3", "--slurm", script.to_str().unwrap()]).output().unwrap();
    assert!(written.status.success(), "{}", String::from_utf8_lossy(&written.stderr));
    let text = fs::read_to_string(&script).unwrap();
    assert!(text.contains("#SBATCH --array=0-1%3\n") && text.contains("#SBATCH --requeue\n"), "{text}");
    // As a node does: the shell, the index, and what the program is called.
    let job = |index: &str| {
        let mut command = Command::new("bash");
        command.arg(&script).env("SLURM_ARRAY_TASK_ID", index).env("RIT", env!("CARGO_BIN_EXE_rit"));
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        command
    };
    assert!(job("1").status().unwrap().success());
    assert_eq!(sweep.status()["counts"]["finished"], 1);
    assert!(job("1").status().unwrap().success(), "once more: it is finished already");
    // A shell that is told to end passes it on; the job that comes back goes on.
    let mut first = job("0").spawn().unwrap();
    sweep.wait_for_running(&mut first, 1);
    kill_process(Pid::from_raw(first.id() as i32).unwrap(), Signal::TERM).unwrap();
    let code = first.wait().unwrap().code();
    assert!([Some(130), Some(0)].contains(&code), "interrupted, or just finished: {code:?}");
    assert!(job("0").status().unwrap().success());
    assert_eq!(sweep.status()["counts"]["finished"], 2);
    refused(
        &sweep
            .arguments(&["--slurm", script.to_str().unwrap()])
            .iter()
            .map(String::as_str)
            .collect::<Vec<_>>(),
        &["is there already; --force writes over it"],
    );
}

#[test]
fn a_cluster_of_containers_is_told_the_whole_sweep() {
    // A first line that is indented has its place too.
    let text = format!("  # Two methods{}", SWEEP.replace("\"matrix-game\"", "\"own/small game.toml\""));
    let sweep = Sweep::new(&text);
    let own = sweep.folder.path().join("own/small game.toml");
    fs::create_dir(own.parent().unwrap()).unwrap();
    fs::write(&own, "environment.task_set = \"matrix-game\"\n").unwrap();
    let out = sweep.folder.path().join("job.yaml");
    let written = sweep.command(&["--kubernetes", out.to_str().unwrap(), "--queue", "lab"]).output().unwrap();
    assert!(written.status.success(), "{}", String::from_utf8_lossy(&written.stderr));
    let job = fs::read_to_string(&out).unwrap();
    let (_, data) = job.split_once("  sweep.toml: |2\n").unwrap();
    let (data, _) = data.split_once("  experiment-0.toml: |2\n").unwrap();
    let found: String =
        data.lines().map(|line| line.strip_prefix("    ").unwrap_or(line).to_owned() + "\n").collect();
    assert_eq!(found, text);
    let own = "  experiment-0.toml: |2\n    environment.task_set = \"matrix-game\"\n---\n";
    let item = "- { key: experiment-0.toml, path: \"own/small game.toml\" }\n";
    for part in [
        own,
        item,
        "name: rit-two-methods\n",
        "completions: 4\n",
        "suspend: true\n",
        "kueue.x-k8s.io/queue-name: lab\n",
    ] {
        assert!(job.contains(part), "{part} in {job}");
    }
    // The same from where the file lies, by its name alone.
    let here = rit(&["sweep", "two methods.toml", "--dir", "runs", "--kubernetes", "here.yaml"])
        .current_dir(sweep.folder.path())
        .output()
        .unwrap();
    assert!(here.status.success(), "{}", String::from_utf8_lossy(&here.stderr));
    assert!(fs::read_to_string(sweep.folder.path().join("here.yaml")).unwrap().contains(item));
}
