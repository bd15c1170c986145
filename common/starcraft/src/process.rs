//! A game's process: on a port of its own, in a temporary folder of its own, and gone when its owner is.

use crate::{connection::shown, error::StarCraftError, installation::Installation};
use rustix::process::{Pid, Signal, kill_process};
use std::{
    env,
    ffi::OsString,
    fs, io,
    net::{Ipv4Addr, SocketAddr, TcpListener},
    os::unix::process::CommandExt as _,
    path::{Path, PathBuf},
    process::{Child, Command, ExitStatus, Stdio},
    sync::mpsc,
    thread,
    time::{Duration, Instant},
};
use tempfile::TempDir;

/// The hidden command of this program that executes a game which ends with its parent: see [`execute`].
pub const WRAPPER: &str = "starcraft-game";

/// How long a game that was asked to quit, and then one that was told to, may take.
const QUIT_TIMEOUT: Duration = Duration::from_secs(3);

/// From one look at it to the next.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// Bytes of a game's output that are shown, the last ones.
const OUTPUT_MAX: usize = 400;

/// Starts games, on a thread of its own: a game is killed when the thread that started it ends, and rolling goes on
/// from thread to thread.
#[derive(Debug)]
pub(crate) struct Starter(mpsc::Sender<(Command, mpsc::Sender<io::Result<Child>>)>);

impl Starter {
    pub(crate) fn new() -> io::Result<Self> {
        let (starts, queue) = mpsc::channel::<(Command, mpsc::Sender<io::Result<Child>>)>();
        thread::Builder::new().name("starcraft".into()).spawn(move || {
            while let Ok((mut command, answer)) = queue.recv() {
                // The caller waits for it.
                let _ = answer.send(command.spawn());
            }
        })?;
        Ok(Self(starts))
    }

    fn start(&self, command: Command) -> io::Result<Child> {
        let gone = || io::Error::other("the thread that starts games has ended");
        let (answer, started) = mpsc::channel();
        self.0.send((command, answer)).map_err(|_| gone())?;
        started.recv().map_err(|_| gone())?
    }
}

/// A game that was started.
#[derive(Debug)]
pub(crate) struct GameProcess {
    child: Child,
    address: SocketAddr,
    program: PathBuf,
    /// Removed with it.
    folder: TempDir,
}

impl GameProcess {
    /// Starts the game; it takes its time to come up.
    pub(crate) fn start(starter: &Starter, installation: &Installation) -> Result<Self, StarCraftError> {
        let program = &installation.program;
        let failed = |error| StarCraftError::Launch { program: program.display().to_string(), error };
        let folder = tempfile::Builder::new().prefix("rit-starcraft-").tempdir().map_err(failed)?;
        let address = free_address().map_err(failed)?;
        let output = fs::File::create(output_file(folder.path())).map_err(failed)?;
        let mut command = Command::new("/proc/self/exe");
        command
            .args([WRAPPER, &std::process::id().to_string()])
            .arg(program)
            .args(game_arguments(installation, address, folder.path()))
            .current_dir(&installation.folder)
            .env("LD_LIBRARY_PATH", library_path(&installation.folder))
            .stdin(Stdio::null())
            .stdout(output.try_clone().map_err(failed)?)
            .stderr(output);
        let child = starter.start(command).map_err(failed)?;
        tracing::info!(pid = child.id(), %address, program = %program.display(), "a game is started");
        Ok(Self { child, address, program: program.clone(), folder })
    }

    /// Where it will listen.
    pub(crate) fn address(&self) -> SocketAddr {
        self.address
    }

    /// Why it ended, if it did.
    pub(crate) fn ended(&mut self) -> Option<StarCraftError> {
        let status = self.child.try_wait().ok().flatten()?;
        Some(StarCraftError::Exited {
            program: self.program.display().to_string(),
            status: status.to_string(),
            output: self.last_output(),
        })
    }

    fn last_output(&self) -> String {
        let bytes = fs::read(output_file(self.folder.path())).unwrap_or_default();
        let last = &bytes[bytes.len().saturating_sub(OUTPUT_MAX)..];
        match String::from_utf8_lossy(last).trim() {
            "" => "none".to_owned(),
            words => shown(&words),
        }
    }

    /// Waits for a game that was asked to quit; then it is terminated, then killed.
    pub(crate) fn quit(mut self) {
        if self.wait(QUIT_TIMEOUT).is_none() {
            if let Some(pid) = Pid::from_raw(self.child.id() as i32) {
                // Ended in the meantime is as good.
                let _ = kill_process(pid, Signal::TERM);
            }
            self.wait(QUIT_TIMEOUT);
        }
    }

    fn wait(&mut self, timeout: Duration) -> Option<ExitStatus> {
        let begun = Instant::now();
        loop {
            match self.child.try_wait() {
                Ok(None) if begun.elapsed() < timeout => thread::sleep(LOOK_EVERY),
                Ok(status) => return status,
                Err(_) => return None,
            }
        }
    }
}

impl Drop for GameProcess {
    fn drop(&mut self) {
        // Ended in the meantime is as good.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn output_file(folder: &Path) -> PathBuf {
    folder.join("output.log")
}

/// A port of this machine without a listener.
fn free_address() -> io::Result<SocketAddr> {
    TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?.local_addr()
}

/// Beside what the system has, the game's own libraries.
fn library_path(folder: &Path) -> OsString {
    let own = folder.join("Libs/").into_os_string();
    match env::var_os("LD_LIBRARY_PATH").filter(|path| !path.is_empty()) {
        Some(mut path) => {
            path.push(":");
            path.push(own);
            path
        }
        None => own,
    }
}

fn game_arguments(installation: &Installation, address: SocketAddr, temporary: &Path) -> Vec<OsString> {
    let mut arguments: Vec<OsString> = vec![
        "-listen".into(),
        address.ip().to_string().into(),
        "-port".into(),
        address.port().to_string().into(),
        "-dataDir".into(),
        // With the slash at its end, as the game wants it.
        installation.folder.join("").into(),
        "-tempDir".into(),
        temporary.join("").into(),
    ];
    if !installation.data_version.is_empty() {
        arguments.extend(["-dataVersion".into(), installation.data_version.to_uppercase().into()]);
    }
    arguments
}

/// Becomes another program, which is killed when the process of this number, its parent, ends in whatever way. Returns
/// only when that cannot be done.
pub fn execute(parent: u32, program: &Path, arguments: &[OsString]) -> io::Error {
    if let Err(error) = rustix::process::set_parent_process_death_signal(Some(Signal::KILL)) {
        return error.into();
    }
    let is_there = rustix::process::getppid().is_some_and(|pid| pid.as_raw_nonzero().get() as u32 == parent);
    if !is_there {
        return io::Error::other(format!("process {parent} has gone"));
    }
    Command::new(program).args(arguments).exec()
}
