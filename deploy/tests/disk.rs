//! A disk that is full, or read-only: said in words, and nothing is lost.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, output};
use rustix::mount::{MountFlags, UnmountFlags, mount, mount_remount, unmount};
use std::{
    fs,
    path::{Path, PathBuf},
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
    assert!(stderr.contains("free some space, training goes on meanwhile"), "{stderr}");
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
