//! Around the supervisor: the processes, the clock, and the way to the learner.

use super::{Effect, Event, Exit, Hung, Outcome, Place, Standing, Supervisor, process::Processes};
use crate::{
    control, logging::LogOptions, progress::Progress, report::printable_sentence, shutdown,
    traceback::marked, warnings::Warnings,
};
use rit_config::{OwnedRunDir, RunDir};
use rit_learner::life;
use rit_proto::{
    transport::Client,
    v1::{RunState, RunStatus, StatusRequest, StopRequest, control_client::ControlClient},
};
use rit_record::Summary;
use std::{
    collections::{BTreeSet, VecDeque},
    fs,
    io::ErrorKind,
    pin::Pin,
    time::Duration,
};
use tokio::time::Instant;

/// From one look for the learner's address to the next.
const START_POLL: Duration = Duration::from_millis(10);

/// From one look at the run's status to the next.
const STATUS_EVERY: Duration = Duration::from_millis(200);

/// What came of trying to speak to the learner.
enum Contacted {
    Connected(ControlClient<Client>),
    Status(Box<RunStatus>),
    Failed(String),
}

type Contact<'a> = Pin<Box<dyn Future<Output = Contacted> + 'a>>;

/// Starts the processes of a run with so many actors, and watches over them until all have ended for good. The second
/// value says whether the run has begun: a learner has answered. Where it is `supervised`, the end of standard input asks
/// it to end.
pub async fn watch_over(
    owned: &OwnedRunDir,
    log_options: &LogOptions,
    progress: &mut Progress,
    actors: u32,
    supervised: bool,
) -> (Outcome, bool) {
    let run_dir = owned.run_dir();
    // Starting a run resumes it: its pause ended with the processes that were paused.
    let _ = fs::remove_file(run_dir.paused());
    let mut shell = Shell {
        supervisor: Supervisor::new(actors, run_dir.logs().display().to_string()),
        began: Instant::now(),
        run_dir,
        progress,
        warnings: Warnings::default(),
        processes: Processes::new(owned, log_options),
        control: None,
        contact: Box::pin(std::future::pending()),
        web_url: None,
        is_gone: false,
        tracebacks: BTreeSet::new(),
    };
    let mut requests = shutdown::Requests::new(supervised);
    let mut event = Event::Begin;
    loop {
        if let Some(outcome) = shell.handle(event) {
            return (outcome, shell.supervisor.has_begun());
        }
        let deadline = shell.supervisor.deadline().map(|at| shell.began + at);
        event = tokio::select! {
            (place, exit) = shell.processes.next_end() => shell.ended(place, exit),
            contacted = &mut shell.contact => shell.contacted(contacted),
            () = at(deadline) => Event::Tick,
            () = requests.next() => Event::Interrupted,
        };
    }
}

async fn at(deadline: Option<Instant>) {
    match deadline {
        Some(deadline) => tokio::time::sleep_until(deadline).await,
        None => std::future::pending().await,
    }
}

struct Shell<'a> {
    supervisor: Supervisor,
    /// The moment that the supervisor's times count from.
    began: Instant,
    run_dir: &'a RunDir,
    progress: &'a mut Progress,
    warnings: Warnings,
    processes: Processes<'a>,
    /// The learner, once it has answered.
    control: Option<ControlClient<Client>>,
    /// What is under way with it.
    contact: Contact<'a>,
    /// The web page's address, once it was said.
    web_url: Option<String>,
    /// The run directory was not there at the last look.
    is_gone: bool,
    /// Those that were shown.
    tracebacks: BTreeSet<String>,
}

impl Shell<'_> {
    /// Passes an event on and does what comes of it. Returns how the run ended, once it has.
    fn handle(&mut self, event: Event) -> Option<Outcome> {
        let mut events = VecDeque::from([event]);
        while let Some(event) = events.pop_front() {
            for effect in self.supervisor.handle(event, self.began.elapsed()) {
                match effect {
                    Effect::Start(place) => events.extend(self.start(place)),
                    Effect::AskToEnd(place) => self.processes.ask_to_end(place),
                    Effect::Kill(place) => self.processes.kill(place),
                    Effect::StopRun => self.stop_run(),
                    Effect::RemoveSharedMemory => life::remove_dead(self.run_dir),
                    Effect::Say(line) => self.progress.say(&line),
                    Effect::Over(outcome) => {
                        self.say_last_warnings();
                        return Some(outcome);
                    }
                }
            }
        }
        None
    }

    fn start(&mut self, place: Place) -> Option<Event> {
        if place == Place::Learner {
            // What a learner that was killed has left would be taken for the new one's.
            let _ = fs::remove_file(self.run_dir.address());
            self.contact = Box::pin(reach(self.run_dir.clone()));
        }
        match self.processes.start(place) {
            Ok(pid) => pid.map(|pid| Event::Started(place, pid)),
            Err(error) => {
                let last_words = error.to_string();
                Some(Event::Ended { place, exit: Exit::NotStarted(last_words.clone()), last_words })
            }
        }
    }

    fn ended(&mut self, place: Place, exit: Exit) -> Event {
        if place == Place::Learner {
            self.control = None;
            self.contact = Box::pin(std::future::pending());
        }
        self.say_traceback(place);
        Event::Ended { place, exit, last_words: self.processes.last_words(place) }
    }

    /// Shows where in an environment's code a process's last error was raised, each place once: what is said of the end
    /// is a line.
    fn say_traceback(&mut self, place: Place) {
        if let Some(traceback) = self.processes.last_traceback(place)
            && self.tracebacks.insert(traceback.clone())
        {
            self.progress.say(&marked(&traceback));
        }
    }

    fn contacted(&mut self, contacted: Contacted) -> Event {
        let event = match contacted {
            Contacted::Connected(control) => {
                self.control = Some(control);
                self.say_web_url();
                Event::Answers
            }
            Contacted::Status(status) => {
                let warnings = self.warnings.new_of(&status);
                self.say_warnings(&warnings);
                self.look_for_run_dir();
                self.progress.update(&status);
                Event::Status(standing(&status))
            }
            // A learner that is ending or has just died does not answer; its end is seen by itself.
            Contacted::Failed(why) => Event::NoAnswer(why),
        };
        self.contact = match &self.control {
            Some(control) => Box::pin(ask(control.clone())),
            None => Box::pin(reach(self.run_dir.clone())),
        };
        event
    }

    fn say_warnings(&self, warnings: &[String]) {
        for warning in warnings {
            self.progress.say(&format!("warning: {}", printable_sentence(warning)));
        }
    }

    /// A learner that had little to do may have ended before it was asked how it stands.
    fn say_last_warnings(&mut self) {
        if let Ok(Some(summary)) = Summary::read(self.run_dir) {
            let warnings = self.warnings.left_of(summary.warnings);
            self.say_warnings(&warnings);
        }
    }

    /// Asks the learner to end its run. What was asked before is not waited for: how the run stood then would look as if it
    /// had not heard this.
    fn stop_run(&mut self) {
        if let Some(control) = self.control.clone() {
            self.contact = Box::pin(stop(control));
        }
    }

    /// Says that the run directory is gone, once: training alone would notice it at the next checkpoint.
    fn look_for_run_dir(&mut self) {
        let root = self.run_dir.root();
        let is_gone = fs::metadata(root).is_err_and(|error| error.kind() == ErrorKind::NotFound);
        if is_gone && !self.is_gone {
            let root = root.display();
            self.progress.say(&format!(
                "warning: {root} is gone, removed or renamed: nothing of this run is kept until it is there again"
            ));
        }
        self.is_gone = is_gone;
    }

    /// Says where the web page is, when it is there first and when it moves.
    fn say_web_url(&mut self) {
        let url = self.run_dir.web_url();
        if let Some(url) = url.as_ref().filter(|_| url != self.web_url) {
            // What is no terminal may be a log that others read: the token stays out of it.
            let (page, _) = url.split_once("?token=").unwrap_or((url, ""));
            let root = self.run_dir.root().display();
            self.progress.say(&if self.progress.is_plain() {
                format!("web page: {page} (`rit ctl --run {root} web` says the address that lets you in)")
            } else {
                format!("web page: {url}")
            });
        }
        self.web_url = url;
    }
}

/// Waits until there is a learner, and connects to it.
async fn reach(run_dir: RunDir) -> Contacted {
    tokio::time::sleep(START_POLL).await;
    while !run_dir.address().exists() {
        tokio::time::sleep(START_POLL).await;
    }
    match control::connect(&run_dir).await {
        Ok(control) => Contacted::Connected(control),
        Err(failure) => Contacted::Failed(failure.to_string()),
    }
}

async fn ask(mut control: ControlClient<Client>) -> Contacted {
    tokio::time::sleep(STATUS_EVERY).await;
    match control.status(StatusRequest {}).await {
        Ok(status) => Contacted::Status(Box::new(status.into_inner())),
        Err(status) => Contacted::Failed(status.message().to_owned()),
    }
}

async fn stop(mut control: ControlClient<Client>) -> Contacted {
    match control.stop(StopRequest { drain: false, interrupted: true }).await {
        Ok(status) => Contacted::Status(Box::new(status.into_inner())),
        Err(status) => Contacted::Failed(status.message().to_owned()),
    }
}

fn standing(status: &RunStatus) -> Standing {
    // The process of an actor on another host has a number that may be another process's here.
    let hung = status.actors.iter().filter(|actor| actor.hung && !actor.remote);
    Standing {
        actors_wanted: status.actors_wanted,
        hung: hung.map(|actor| Hung { pid: actor.pid, silent_s: actor.silent_s as u64 }).collect(),
        ending: status.state() == RunState::Stopping,
    }
}
