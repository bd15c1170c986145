//! A disk that is full, or read-only: said in words, and nothing is lost.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, Train, output};
use rustix::{
    mount::{MountFlags, UnmountFlags, mount, mount_remount, unmount},
    process::Signal,
};
use std::{
    fs,
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

/// The folder of a run on a small file system of its own, where this process may make one.
struct SmallDisk(PathBuf);

impl SmallDisk {
    fn mount(folder: &RunFolder) -> Option<Self> {
        let path = folder.path().to_owned();
        let size = c"size=8m,mode=0700";
        match mount("tmpfs", &path, "tmpfs", MountFlags::empty(), Some(size)) {
            Ok(()) => Some(Self(path)),
            Err(error) => {
                println!("skipped: no file system can be mounted here ({error})");
                None
            }
        }
    }

    /// Takes all the room there is; gives it back when the file is removed.
    fn fill(&self) -> PathBuf {
        let path = self.0.join("filler");
        let mut size = 8 << 20;
        let mut filler = fs::File::create(&path).unwrap();
        while size > 0 {
            if std::io::Write::write_all(&mut filler, &vec![1; size]).is_err() {
                size /= 2;
            }
        }
        path
    }

    fn set_read_only(&self, read_only: bool) {
        let flags = if read_only { MountFlags::RDONLY } else { MountFlags::empty() };
        mount_remount(&self.0, flags, "").unwrap();
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = unmount(&self.0, UnmountFlags::DETACH);
    }
}

const RUN: &[&str] = &["matrix-game", "--seed", "3", "--steps", "6000", "--actors", "1"];

#[test]
fn a_full_disk_costs_a_checkpoint_and_nothing_else() {
    let (folder, undisturbed) = (RunFolder::new(), RunFolder::new());
    let Some(disk) = SmallDisk::mount(&folder) else { return };
    let mut train = folder.start(RUN);
    let before = train.wait_for("training", |status| status["updates"].as_u64() > Some(100));
    let filler = disk.fill();
    let refused = train.ctl(&["checkpoint"]);
    let stderr = String::from_utf8_lossy(&refused.stderr);
    assert_eq!(refused.status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("free some space"), "{stderr}");
    let steps = |status: &serde_json::Value| status["env_steps"].as_u64().unwrap();
    train.wait_for("training without a disk", |status| steps(status) > steps(&before) + 500);

    fs::remove_file(filler).unwrap();
    let written = train.ctl(&["checkpoint"]);
    assert!(written.status.success(), "{}", String::from_utf8_lossy(&written.stderr));
    let summary = train.finish();
    assert_eq!(summary["weights_digest"], undisturbed.train(RUN)["weights_digest"]);
    let lines = |run_dir: &Path| fs::read_to_string(run_dir.join("metrics.jsonl")).unwrap().lines().count();
    assert_eq!(lines(&folder.run_dir()), lines(&undisturbed.run_dir()), "no line of the metrics is missing");
}

#[test]
fn a_disk_that_is_full_at_the_end_keeps_the_weights() {
    let (folder, elsewhere) = (RunFolder::new(), RunFolder::new());
    let Some(disk) = SmallDisk::mount(&folder) else { return };
    let rescue = format!("checkpoints.rescue_dir={}", elsewhere.path().display());
    let mut train = folder.start(&[RUN, &["--steps", "1000000", "--set", &rescue]].concat());
    train.wait_for("training", |status| status["updates"].as_u64() > Some(100));
    let filler = disk.fill();
    assert!(train.ctl(&["stop"]).status.success());
    let refused = train.wait_for("a warning", |status| {
        status["happenings"].to_string().contains("the last checkpoint is not written")
    });
    assert_eq!(refused["state"], "stopping");
    // Room again while it tries: nothing is lost.
    fs::remove_file(&filler).unwrap();
    let summary = train.finish_stopped();
    let digest = summary["weights_digest"].as_str().unwrap();
    assert!(folder.run_dir().join("checkpoints/latest/weights.safetensors").exists());

    // No room until it gives up: the weights are in the other place.
    let mut train = Train::resume(&folder, &["--set", "checkpoints.last_retry_ms=0"]);
    train.wait_for("training", |status| status["updates"].as_u64() > Some(200));
    disk.fill();
    assert!(train.ctl(&["stop"]).status.success());
    let output = train.wait();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("the last weights are in"), "{stderr}");
    let rescued = fs::read_dir(elsewhere.path()).unwrap().next().unwrap().unwrap();
    assert!(rescued.file_name().to_str().unwrap().starts_with("run-step-"));
    assert!(rescued.metadata().unwrap().len() > 1000 && !digest.is_empty());
}

/// By default the last checkpoint is tried for ten minutes.
#[test]
fn a_second_interrupt_ends_the_wait_for_a_disk_that_stays_full() {
    let folder = RunFolder::new();
    let Some(disk) = SmallDisk::mount(&folder) else { return };
    let mut train = folder.start(&[RUN, &["--steps", "1000000"]].concat());
    train.wait_for("training", |status| status["updates"].as_u64() > Some(100));
    disk.fill();
    train.signal(Signal::INT);
    train.wait_for("a warning", |status| {
        status["happenings"].to_string().contains("the last checkpoint is not written")
    });
    let begun = Instant::now();
    train.signal(Signal::INT);
    let output = train.wait();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    assert!(begun.elapsed() < Duration::from_secs(120), "{:?}", begun.elapsed());
}

#[test]
fn a_read_only_run_directory_is_named() {
    let folder = RunFolder::new();
    let Some(disk) = SmallDisk::mount(&folder) else { return };
    disk.set_read_only(true);
    let root = folder.run_dir();
    let refused = output(&["train", "matrix-game", "--run-dir", root.to_str().unwrap()]);
    let stderr = String::from_utf8_lossy(&refused.stderr);
    assert_eq!(refused.status.code(), Some(2), "{stderr}");
    assert!(stderr.contains(root.to_str().unwrap()) && stderr.contains("Read-only file system"), "{stderr}");
}
