//! `rit watch`: a run in the terminal, for as long as it lasts. It only looks: ending the view leaves the run alone.

mod model;
mod screen;
mod view;

use crate::{
    cli::WatchOptions,
    control::{self, Reached},
    failure::Failure,
    finished::Finished,
    output::{self, Reader},
    report, shutdown,
};
use model::Model;
use rit_config::{Config, RunDir};
use rit_proto::v1::{MetricsRequest, StatusRequest, metrics_update::Update};
use screen::Screen;
use std::{
    fs,
    process::ExitCode,
    time::{Duration, Instant, SystemTime},
};

/// From one status to the next.
const STATUS_EVERY_MS: u32 = 500;

/// How long a learner that has died is waited for: `rit train` restarts it at once.
const AWAY_TIMEOUT: Duration = Duration::from_secs(60);

/// From one look for it to the next.
const AWAY_POLL: Duration = Duration::from_millis(200);

/// `rit watch`.
pub async fn run(options: &WatchOptions) -> Result<ExitCode, Failure> {
    let (run_dir, config) = RunDir::open(&options.run)?;
    // Before the screen changes: a run that is not there, or over.
    if let Reached::Over(finished) = control::reach(&run_dir).await? {
        output::print(&finished.status_text())?;
        return Ok(ExitCode::SUCCESS);
    }
    let name =
        run_dir.root().file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
    let mut model = Model::new(name);
    let mut screen = Screen::open()?;
    let watched = tokio::select! {
        watched = watch(&run_dir, &config, &mut model, &mut screen) => watched,
        () = shutdown::requested(false) => Ok(Ended::Quit),
    };
    screen.close();
    match watched? {
        Ended::Over => output::print(&Finished::read(&run_dir)?.text())?,
        Ended::Quit => output::print(&(report::status_line(&model.status) + "\n"))?,
    };
    Ok(ExitCode::SUCCESS)
}

/// Why there is nothing more to watch.
enum Ended {
    /// The run is over.
    Over,
    /// `q` or Ctrl-C ended the view.
    Quit,
}

/// Until the run is over, or `q` or Ctrl-C ends the view.
async fn watch(
    run_dir: &RunDir,
    config: &Config,
    model: &mut Model,
    screen: &mut Screen,
) -> Result<Ended, Failure> {
    let began = SystemTime::now();
    let mut heard = Instant::now();
    loop {
        match follow(run_dir, config, model, screen).await {
            Ok(Some(ended)) => return Ok(ended),
            Ok(None) => heard = Instant::now(),
            // Not back yet.
            Err(error) if heard.elapsed() >= AWAY_TIMEOUT => return Err(error),
            Err(_) => {}
        }
        if has_summary_since(run_dir, began) {
            return Ok(Ended::Over);
        }
        model.lost();
        if screen.show(model)? == Reader::Gone {
            return Ok(Ended::Quit);
        }
        if screen.quits_within(AWAY_POLL).await {
            return Ok(Ended::Quit);
        }
    }
}

/// Follows one learner; `None` when its connection breaks.
async fn follow(
    run_dir: &RunDir,
    config: &Config,
    model: &mut Model,
    screen: &mut Screen,
) -> Result<Option<Ended>, Failure> {
    let mut control = control::connect(run_dir).await?;
    let status = control.status(StatusRequest {}).await?.into_inner();
    let shown = model::HISTORY as u64 * config.learner.metrics_every_env_steps;
    let request = MetricsRequest {
        from_env_steps: model.next_env_steps().max(status.env_steps.saturating_sub(shown)),
        follow: true,
        status_every_ms: STATUS_EVERY_MS,
    };
    model.status(status);
    if screen.show(model)? == Reader::Gone {
        return Ok(Some(Ended::Quit));
    }
    let mut updates = control.metrics(request).await?.into_inner();
    loop {
        let update = tokio::select! {
            update = updates.message() => update,
            () = screen.quit() => return Ok(Some(Ended::Quit)),
        };
        match update.map(|update| update.and_then(|update| update.update)) {
            Ok(Some(Update::Line(line))) => model.line(&line),
            Ok(Some(Update::Status(status))) => {
                model.status(status);
                if screen.show(model)? == Reader::Gone {
                    return Ok(Some(Ended::Quit));
                }
            }
            Ok(None) => return Ok(Some(Ended::Over)),
            Err(_) => return Ok(None),
        }
    }
}

/// Whether the run has come to an end in the meantime.
fn has_summary_since(run_dir: &RunDir, began: SystemTime) -> bool {
    let modified = fs::metadata(run_dir.summary()).and_then(|summary| summary.modified());
    modified.is_ok_and(|modified| modified >= began)
}
