//! A named pipe in the place of a run's file: no command waits at it.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, rit};
use rustix::fs::{CWD, Mode, mkfifoat};
use std::{
    fs,
    path::Path,
    process::{Command, Stdio},
    time::{Duration, Instant},
};

/// Far beyond what any of these commands takes: reached only by one that waits.
const DEADLINE: Duration = Duration::from_secs(60);

/// The exit code of a command that ends.
fn code(arguments: &[&str], what: &Path) -> i32 {
    let begun = Instant::now();
    let mut child = rit(arguments).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    loop {
        if let Some(status) = child.try_wait().unwrap() {
            return status.code().unwrap();
        }
        if begun.elapsed() > DEADLINE {
            child.kill().unwrap();
            child.wait().unwrap();
            panic!("{arguments:?} waits at {}", what.display());
        }
        std::thread::yield_now();
    }
}

/// Paths of a folder's files, relative to it.
fn files(folder: &Path, below: &Path, found: &mut Vec<String>) {
    for entry in fs::read_dir(below).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() && !path.is_symlink() {
            files(folder, &path, found);
        } else if path.is_file() {
            found.push(path.strip_prefix(folder).unwrap().to_str().unwrap().to_owned());
        }
    }
}

#[test]
fn no_command_waits_at_a_pipe_in_the_place_of_a_file() {
    let folder = RunFolder::new();
    folder.train(&["matrix-game", "--steps", "40", "--actors", "1", "--set", "evaluation.episodes=1"]);
    let run_dir = folder.run_dir();
    let mut names = Vec::new();
    files(&run_dir, &run_dir, &mut names);
    assert!(names.len() > 12, "{names:?}");
    names
        .extend(["shared_memory", "lineage", "web", "summary.partial", "address.partial"].map(str::to_owned));
    for name in names {
        let copy = folder.path().join("copy");
        assert!(Command::new("cp").arg("-a").args([&run_dir, &copy]).status().unwrap().success());
        let path = copy.join(&name);
        let _ = fs::remove_file(&path);
        mkfifoat(CWD, &path, Mode::RWXU).unwrap();
        let (run, out) = (copy.to_str().unwrap(), folder.path().join("curves.svg"));
        for command in [
            &["ctl", "--run", run, "status"][..],
            &["ctl", "--run", run, "metrics"],
            &["evaluate", "--run", run, "--episodes", "1"],
            &["plot", run, "--force", "--out", out.to_str().unwrap()],
            &["train", "--resume", run, "--set", "web.listen=off"],
        ] {
            let code = code(command, Path::new(&name));
            assert!([0, 1, 2].contains(&code), "{command:?} with {name}: {code}");
        }
        fs::remove_dir_all(&copy).unwrap();
    }
}
