use super::{threads::Thread, *};
use rit_config::OwnedRunDir;
use std::{fs, future, time::Duration};

/// A run that is over at its first evaluation, without an actor.
struct Run {
    _folder: tempfile::TempDir,
    config: Config,
    made: OwnedRunDir,
}

impl Run {
    fn new() -> Self {
        let text = "
            environment.task_set = 'matrix-game'
            training.until = 'mean_return=-1000'
            network.hidden_dim = 8
            evaluation.episodes = 1
            learner.threads = 1
            web.listen = 'off'
        ";
        let config = rit_config::resolve(text, "test", &[]).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let made = OwnedRunDir::create(&folder.path().join("run"), &config).unwrap();
        Self { _folder: folder, config, made }
    }

    fn run_dir(&self) -> &RunDir {
        self.made.run_dir()
    }

    fn summary(&self) -> Option<Summary> {
        Summary::read(self.run_dir()).unwrap()
    }

    fn parts(&self) -> Parts {
        Parts::build(self.run_dir(), self.config.clone(), Build::default(), no_log()).unwrap()
    }
}

fn no_log() -> SetLog {
    Arc::new(|_: &str| Ok(()))
}

/// A thread that panics, as the coordinator and those that wait for it see it.
#[tokio::test]
async fn a_thread_that_panics_ends_the_run_and_is_named() {
    let (events, mut queue) = async_mpsc::channel(1);
    let training = Thread::<()>::spawn("train", &events, || panic!("a fault of the trainer")).unwrap();
    let said = queue.recv().await;
    assert!(matches!(said, Some(Event::Input(Input::Over))), "{said:?}");
    let error = training.end().await.unwrap_err();
    assert!(matches!(error, LearnerError::Panicked("train")), "{error}");
    assert!(error.to_string().starts_with("the train thread panicked"), "{error}");
}

/// The whole learner but for its writer, which panics: nothing goes on, and the summary says why.
#[tokio::test]
async fn a_run_whose_thread_panics_has_failed_by_its_summary() {
    let run = Run::new();
    let run_dir = run.run_dir();
    let _end_of_life = EndOfLife(run_dir);
    let Parts { events, event_queue, coordinator, workers, .. } = run.parts();
    let mut threads = workers.spawn(run_dir, &events).unwrap();
    threads.writing = Thread::spawn("write", &events, || panic!("a fault of the writer")).unwrap();
    coordinate(coordinator.run(event_queue), &events, future::pending()).await;
    threads.stop_receiving();
    let error = threads.end(run_dir).await.unwrap_err();
    assert!(matches!(error, LearnerError::Panicked("write")), "{error}");
    let summary = run.summary().unwrap();
    assert_eq!((summary.ended, summary.reason), (Ended::Failed, Some(error.to_string())));
}

#[tokio::test]
async fn a_finished_run_that_is_resumed_leaves_a_summary() {
    let run = Run::new();
    let run_dir = run.run_dir();
    let learner =
        super::run(run_dir.clone(), run.config.clone(), Build::default(), no_log(), future::pending());
    assert_eq!(learner.await.unwrap().ended, Ended::Until);
    assert_eq!(run.summary().unwrap().ended, Ended::Until);

    let _end_of_life = EndOfLife(run_dir);
    let doors = Doors::open(run_dir, &run.config).await.unwrap();
    let Parts { events, event_queue, coordinator, services, workers } = run.parts();
    let inode = || std::os::unix::fs::MetadataExt::ino(&fs::metadata(run_dir.summary()).unwrap());
    let before = fs::File::open(run_dir.summary()).unwrap();
    let first = inode();
    let threads = workers.spawn(run_dir, &events).unwrap();
    // Nothing is left to train: the trainer may have ended before the learner is served.
    let has_ended = async {
        while !threads.training.has_ended() {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(Duration::from_secs(60), has_ended).await.expect("nothing is left to train");
    assert_ne!(inode(), first, "it is a new one");
    drop(before);
    let ControlService { run: handle, metrics } = services.control.clone();
    let serving = doors.serve(run_dir, &services.routes().await, handle, metrics).unwrap();
    coordinate(coordinator.run(event_queue), &events, future::pending()).await;
    threads.stop_receiving();
    serving.end().await;
    assert_eq!(threads.end(run_dir).await.unwrap().ended, Ended::Until);
    assert_eq!(run.summary().unwrap().ended, Ended::Until);
}

#[tokio::test]
async fn an_interrupt_waits_for_room_in_the_queue_while_the_coordinator_works() {
    let (events, mut queue) = async_mpsc::channel(1);
    events.send(Input::Look.into()).await.unwrap();
    let (interrupt, interrupted) = tokio::sync::oneshot::channel();
    let coordinating = async move {
        interrupted.await.unwrap();
        while !matches!(queue.recv().await, Some(Event::Input(Input::Stop { drain: false, .. }))) {}
    };
    let shutdown = async move { interrupt.send(()).unwrap() };
    let coordinated =
        tokio::time::timeout(Duration::from_secs(60), coordinate(coordinating, &events, shutdown));
    coordinated.await.expect("it is told");
}
