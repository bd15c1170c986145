//! `rit watch` beside a real run: as lines and on a terminal.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, kill, learner_pid, output, rit};
use rustix::{
    process::Signal,
    pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt},
    termios::{Winsize, tcsetwinsize},
};
use std::{
    fs::{self, File, OpenOptions},
    io::{BufRead as _, BufReader, Read as _, Write as _},
    os::unix::ffi::OsStrExt as _,
    process::Stdio,
};

#[test]
fn off_a_terminal_it_prints_lines_through_a_restart_of_the_learner_to_the_end() {
    let folder = RunFolder::new();
    let mut train = folder.start(&["matrix-game", "--steps", "3000", "--seed", "3"]);
    let status = train.wait_for("training", |status| status["updates"].as_u64() > Some(0));
    let run_dir = folder.run_dir();
    let mut watch =
        rit(&["watch", "--run", run_dir.to_str().unwrap()]).stdout(Stdio::piped()).spawn().unwrap();
    let mut printed = BufReader::new(watch.stdout.take().unwrap());
    let mut text = String::new();
    let mut read_until = |text: &mut String, part: &str| {
        while !text.contains(part) {
            assert!(printed.read_line(text).unwrap() > 0, "{part:?} in\n{text}");
        }
    };
    read_until(&mut text, "actor-0 joined");
    read_until(&mut text, " of 3 000 steps · ");
    kill(learner_pid(&status), Signal::KILL);
    read_until(&mut text, "the learner has gone; waiting for it to come back");
    train.finish();
    read_until(&mut text, "3 000 environment steps, 1 500 episodes");
    read_until(&mut text, "run directory");
    assert!(watch.wait().unwrap().success(), "{text}");
    assert!(!text.contains('\u{1b}'), "plain text: {text:?}");
}

#[test]
fn a_run_that_is_over_is_shown_as_what_it_came_to() {
    let folder = RunFolder::new();
    let summary = folder.train(&["matrix-game", "--steps", "100", "--set", "evaluation.episodes=2"]);
    let run_dir = folder.run_dir();
    let run = run_dir.to_str().unwrap();
    let digest = summary["weights_digest"].as_str().unwrap();
    for arguments in [&["watch", "--run", run][..], &["ctl", "--run", run, "status"]] {
        let shown = output(arguments);
        assert_eq!(shown.status.code(), Some(0), "{arguments:?}");
        let text = String::from_utf8(shown.stdout).unwrap();
        for part in ["the run is over", "100 environment steps, 50 episodes", "game-3", digest] {
            assert!(text.contains(part), "{part:?} in\n{text}");
        }
    }
    let status = output(&["ctl", "--run", run, "--json", "status"]);
    let status: serde_json::Value = serde_json::from_slice(&status.stdout).unwrap();
    assert_eq!((&status["state"], &status["summary"]), (&"over".into(), &summary));
    let metrics = String::from_utf8(output(&["ctl", "--run", run, "metrics"]).stdout).unwrap();
    assert!(metrics.starts_with("0 steps · 0 updates · greedy: return "), "{metrics}");

    for (command, words) in [("web", "the run is over and its page with it"), ("pause", "goes on with it")] {
        let refused = output(&["ctl", "--run", run, command]);
        let stderr = String::from_utf8_lossy(&refused.stderr);
        assert_eq!(refused.status.code(), Some(1), "{command}");
        assert!(stderr.contains(words) && stderr.lines().count() == 1, "{stderr}");
    }
    // One that was killed before its end is not over: what its checkpoints hold was never summed up.
    fs::remove_file(run_dir.join("summary.json")).unwrap();
    let watch = output(&["watch", "--run", run]);
    assert_eq!(watch.status.code(), Some(1));
    let stderr = String::from_utf8_lossy(&watch.stderr);
    assert!(
        stderr.starts_with("error: no learner runs for ") && stderr.contains("rit train --resume"),
        "{stderr}"
    );
}

/// A pseudo-terminal of the usual size: the user's side, and the process's side.
fn terminal() -> (File, File) {
    let controller = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
    grantpt(&controller).unwrap();
    unlockpt(&controller).unwrap();
    let name = ptsname(&controller, Vec::new()).unwrap();
    let path = std::ffi::OsStr::from_bytes(name.to_bytes());
    let terminal = OpenOptions::new().read(true).write(true).open(path).unwrap();
    tcsetwinsize(&terminal, Winsize { ws_row: 24, ws_col: 80, ws_xpixel: 0, ws_ypixel: 0 }).unwrap();
    (File::from(controller), terminal)
}

#[test]
fn on_a_terminal_it_draws_and_q_or_ctrl_c_ends_the_view_alone() {
    let folder = RunFolder::new();
    let mut train = folder.start(&["matrix-game", "--seed", "3"]);
    train.wait_for("training", |status| status["updates"].as_u64() > Some(0));
    let run_dir = folder.run_dir();
    for key in [b'q', 3] {
        let (mut controller, terminal) = terminal();
        let mut command = rit(&["watch", "--run", run_dir.to_str().unwrap()]);
        command.stdin(terminal.try_clone().unwrap()).stdout(terminal);
        let mut watch = command.spawn().unwrap();
        // It would hold the terminal open beyond the process's end.
        drop(command);
        let (mut shown, mut buffer, mut asked) = (Vec::new(), [0; 4096], false);
        // A terminal that no process has open any more cannot be read.
        while let Ok(read) = controller.read(&mut buffer) {
            shown.extend_from_slice(&buffer[..read]);
            // One word: blanks are not drawn.
            if !asked && String::from_utf8_lossy(&shown).contains("quits") {
                controller.write_all(&[key]).unwrap();
                asked = true;
            }
        }
        assert!(watch.wait().unwrap().success());
        let shown = String::from_utf8_lossy(&shown);
        let (entered, left) = (shown.find("\u{1b}[?1049h"), shown.find("\u{1b}[?1049l"));
        assert!(entered.is_some() && entered < left, "{shown:?}");
        assert!(shown[left.unwrap()..].contains(" of 50 000 steps"), "the last line stays: {shown:?}");
    }
    train.wait_for("training after all", |status| status["state"] == "running");
    train.ctl(&["stop"]);
    train.finish_stopped();
}
