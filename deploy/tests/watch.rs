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
    fs::{File, OpenOptions},
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
fn a_run_that_is_not_there_is_said_at_once() {
    let folder = RunFolder::new();
    folder.train(&["matrix-game", "--steps", "100"]);
    let run_dir = folder.run_dir();
    let watch = output(&["watch", "--run", run_dir.to_str().unwrap()]);
    assert_eq!(watch.status.code(), Some(1));
    let stderr = String::from_utf8_lossy(&watch.stderr);
    assert!(stderr.starts_with("error: no learner runs for "), "{stderr}");
}

/// A pseudo-terminal of the usual size: whoever sits at it, and what a process gets.
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
        // A terminal that nobody has open any more cannot be read.
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
    train.finish();
}
