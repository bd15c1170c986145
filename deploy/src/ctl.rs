//! `rit ctl`: asks something of a running learner.

use crate::{
    cli::{CtlCommand, CtlOptions},
    control::{self, Reached},
    failure::Failure,
    finished::{self, Finished},
    output::{self, Reader},
    report,
};
use rit_config::{RunDir, in_program_words};
use rit_proto::{
    transport::{self, Client},
    v1::{
        CheckpointRequest, EvaluateRequest, Evaluation, MetricsLine, MetricsRequest, PauseRequest,
        ResumeRequest, RunStatus, SetRequest, StatusRequest, StopRequest, control_client::ControlClient,
        metrics_update::Update,
    },
};
use std::{
    path::{Path, PathBuf},
    process::ExitCode,
};

/// `rit ctl`.
pub async fn run(options: CtlOptions) -> Result<ExitCode, Failure> {
    let (mut control, root) = match (options.address, options.run) {
        (Some(address), _) => {
            let client = transport::connect(&address, &options.credentials.read()?).await?;
            // Paths are then those of the learner's host, relative to its run directory.
            (ControlClient::new(client), PathBuf::new())
        }
        (None, Some(run)) => {
            let (run_dir, _) = RunDir::open(&run)?;
            match control::reach(&run_dir).await? {
                Reached::Learner(control) => (control, run_dir.root().to_owned()),
                Reached::Over(finished) => {
                    return over(&run_dir, &finished, &options.command, options.json);
                }
            }
        }
        (None, None) => return Err(Failure::input_message("which run? give --run DIR or --address ADDRESS")),
    };
    let text = match options.command {
        CtlCommand::Status => status(&control.status(StatusRequest {}).await?.into_inner(), options.json)?,
        CtlCommand::Pause => status(&control.pause(PauseRequest {}).await?.into_inner(), options.json)?,
        CtlCommand::Resume => status(&control.resume(ResumeRequest {}).await?.into_inner(), options.json)?,
        CtlCommand::Stop { drain } => status(
            &control.stop(StopRequest { drain, interrupted: false }).await?.into_inner(),
            options.json,
        )?,
        CtlCommand::Set { settings } => {
            status(&control.set(set_request(&settings)?).await?.into_inner(), options.json)?
        }
        CtlCommand::Evaluate { tasks, episodes, seed } => {
            let request = EvaluateRequest { tasks, episodes: episodes.unwrap_or(0), seed };
            evaluation(&control.evaluate(request).await?.into_inner(), options.json)?
        }
        CtlCommand::Checkpoint => {
            let written = control.checkpoint(CheckpointRequest {}).await?.into_inner();
            let path = root.join(&written.path);
            let words = format!("{}\nweights digest {}\n", path.display(), written.weights_digest);
            if options.json { json(&written)? } else { words }
        }
        CtlCommand::Metrics { follow, from } => {
            metrics(
                &mut control,
                MetricsRequest { from_env_steps: from, follow, ..Default::default() },
                options.json,
            )
            .await?;
            return Ok(ExitCode::SUCCESS);
        }
        CtlCommand::Web => web(&root, options.json)?,
    };
    output::print(&text)?;
    Ok(ExitCode::SUCCESS)
}

/// What can be asked of a run that is over, from its run directory.
fn over(
    run_dir: &RunDir,
    finished: &Finished,
    command: &CtlCommand,
    as_json: bool,
) -> Result<ExitCode, Failure> {
    match command {
        CtlCommand::Status => {
            output::print(&if as_json { finished.status_json() } else { finished.status_text() })?;
        }
        CtlCommand::Metrics { from, .. } => {
            let mut metrics = finished::Metrics::open(&run_dir.metrics(), *from)?;
            while let Some(line) = metrics.next_line()? {
                if print_line(&line, as_json)? == Reader::Gone {
                    break;
                }
            }
        }
        CtlCommand::Web => return Err(finished.no_page()),
        _ => return Err(finished.refusal()),
    }
    Ok(ExitCode::SUCCESS)
}

/// What is to be set; `log` is no key of the configuration.
fn set_request(settings: &[String]) -> Result<SetRequest, Failure> {
    let mut request = SetRequest::default();
    for setting in settings {
        match setting.split_once('=') {
            Some(("log", filter)) => filter.clone_into(&mut request.log),
            Some((key, value)) => {
                request.settings.insert(key.trim().to_owned(), value.trim().to_owned());
            }
            None => {
                return Err(Failure::input_message(format!("{setting:?} is no setting; write KEY=VALUE")));
            }
        }
    }
    Ok(request)
}

/// Prints metrics as they come. Their reader may stop reading.
async fn metrics(
    control: &mut ControlClient<Client>,
    request: MetricsRequest,
    as_json: bool,
) -> Result<(), Failure> {
    let mut updates = control.metrics(request).await?.into_inner();
    while let Some(update) = updates.message().await? {
        let Some(Update::Line(line)) = update.update else { continue };
        if print_line(&line, as_json)? == Reader::Gone {
            return Ok(());
        }
    }
    Ok(())
}

fn print_line(line: &MetricsLine, as_json: bool) -> Result<Reader, Failure> {
    let text =
        if as_json { serde_json::to_string(line).map_err(Failure::runtime)? } else { report::line(line) };
    output::print(&(text + "\n"))
}

fn web(root: &Path, as_json: bool) -> Result<String, Failure> {
    if root.as_os_str().is_empty() {
        let message = "the web page is served to the learner's own machine; ask there, with --run DIR";
        return Err(Failure::input_message(message));
    }
    let (run_dir, _) = RunDir::open(root)?;
    let off = || Failure::input_message("the run serves no web page: web.listen = \"off\"");
    let url = run_dir.web_url().ok_or_else(off)?;
    if as_json { json(&serde_json::json!({ "url": url })) } else { Ok(url + "\n") }
}

fn json(message: &impl serde::Serialize) -> Result<String, Failure> {
    serde_json::to_string_pretty(message).map(|text| text + "\n").map_err(Failure::runtime)
}

fn evaluation(evaluation: &Evaluation, as_json: bool) -> Result<String, Failure> {
    if as_json {
        return json(evaluation);
    }
    let at = format!(
        "weights {} at {} steps\n",
        evaluation.weights_version,
        report::grouped(evaluation.env_steps)
    );
    Ok(at + &report::table(&evaluation.tasks))
}

fn status(status: &RunStatus, as_json: bool) -> Result<String, Failure> {
    if as_json {
        return json(status);
    }
    let (state, grouped) = (report::state(status), report::grouped);
    let rates = status.rates.unwrap_or_default();
    let actors_waited: f64 = status.actors.iter().map(|actor| actor.waiting_s).sum();
    let mut lines = vec![
        format!("{state} for {}", report::duration(status.wall_s)),
        format!("environment steps  {} of {}", grouped(status.env_steps), grouped(status.env_steps_max)),
        format!(
            "episodes           {}, {} in replay",
            grouped(status.episodes),
            grouped(status.replay_episodes)
        ),
        format!("updates            {}", grouped(status.updates)),
        format!(
            "rates              {:.0} steps/s, {:.0} updates/s",
            rates.env_steps_per_s, rates.updates_per_s
        ),
        format!(
            "waited             learner {}, actors {}",
            report::duration(status.learner_waiting_s),
            report::duration(actors_waited)
        ),
        format!("epsilon            {:.3}", status.epsilon),
    ];
    lines.extend(status.measures.iter().map(|it| format!("{:18} {:.4}", report::words(&it.name), it.value)));
    if let Some(ledger) = &status.ledger {
        let rejected: u64 = ledger.rejected.values().sum();
        lines.push(format!(
            "ledger             {} handed out = {} inserted + {} outstanding + {} taken back",
            grouped(ledger.handed_out),
            grouped(ledger.inserted),
            grouped(ledger.outstanding),
            grouped(rejected)
        ));
        lines.extend(report::reasons(&ledger.rejected).map(|words| format!("taken back         {words}")));
        lines.extend(
            report::reasons(&ledger.frames_refused).map(|words| format!("frames refused     {words}")),
        );
    }
    lines.push(format!("{:18} process {}", "learner", status.pid));
    for actor in &status.actors {
        let (name, pid) = (report::printable(&actor.name), actor.pid);
        let on_another_host = if actor.remote { " on another host" } else { "" };
        let episodes = grouped(actor.episodes);
        lines.push(format!("{name:18} process {pid}{on_another_host}, {episodes} episodes"));
    }
    let mut text = lines.join("\n") + "\n";
    if !status.recent.is_empty() {
        text += "\nexploring episodes of late\n";
        text += &report::brief_table(&status.recent, "`rit ctl … --json status` has all");
    }
    if let Some(evaluation) = &status.evaluation {
        text += &format!("\ngreedy evaluation at {} steps\n", grouped(evaluation.env_steps));
        text += &report::brief_table(&evaluation.tasks, "`rit ctl … --json status` has all");
    }
    Ok(in_program_words(&text).into_owned())
}
