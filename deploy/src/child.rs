//! How this program starts itself again, as a child process.

use command_fds::{CommandFdExt as _, FdMapping};
use rit_config::{RunLock, open_regular, program_name};
use std::{
    fs::{self, DirBuilder, OpenOptions},
    io::{self, ErrorKind},
    os::{
        fd::BorrowedFd,
        unix::{
            fs::{DirBuilderExt as _, OpenOptionsExt as _},
            process::CommandExt as _,
        },
    },
    path::Path,
    process::{Command, Stdio},
};
use tokio::process::Child;

/// A command that executes the program that is running, whatever has become of its file since: replaced by another
/// build, moved, removed.
pub fn this_program() -> Command {
    let mut command = Command::new("/proc/self/exe");
    // Children are told it, and process lists show it.
    command.arg0(program_name());
    command
}

/// Gives this process the program's name, which one that was started by [`this_program`] lacks.
pub fn take_name() {
    const NAME: &str = "/proc/self/comm";
    if fs::read_to_string(NAME).is_ok_and(|name| name.trim_end() == "exe") {
        // For people's eyes alone.
        let _ = fs::write(NAME, program_name());
    }
}

/// Starts a command of [`this_program`]; its standard error is appended to a file, its standard input is a pipe, and it
/// is handed the run's lock, if one is given.
///
/// # Errors
/// When the system refuses.
pub fn spawn(mut command: Command, log: &Path, lock: Option<BorrowedFd<'_>>) -> io::Result<Child> {
    if let Some(folder) = log.parent() {
        // It may have been removed since the run began. Where the whole run directory is gone, none is made in its
        // place.
        match DirBuilder::new().mode(0o700).create(folder) {
            Err(error) if error.kind() != ErrorKind::AlreadyExists => {
                return Err(io::Error::new(error.kind(), format!("{}: {error}", folder.display())));
            }
            _ => {}
        }
    }
    let log = open_regular(log, OpenOptions::new().create(true).append(true).mode(0o600))
        .map_err(|error| io::Error::new(error.kind(), format!("{}: {error}", log.display())))?;
    command
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(log)
        // A terminal's Ctrl-C reaches this process alone, which then shuts the others down gracefully.
        .process_group(0);
    if let Some(lock) = lock {
        let parent_fd = lock.try_clone_to_owned()?;
        let mapping = FdMapping { parent_fd, child_fd: RunLock::CHILD_FD };
        command.fd_mappings(vec![mapping]).map_err(io::Error::other)?;
    }
    tokio::process::Command::from(command).kill_on_drop(true).spawn()
}
