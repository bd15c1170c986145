//! `rit starcraft-endpoint`, `rit starcraft-check`, and the hidden command that games are executed by.

use crate::{
    cli::{EndpointOptions, GameOptions, StarCraftCheckOptions},
    experiments,
    failure::Failure,
    logging::LogOptions,
    new_file, output, shutdown,
};
use rit_config::Config;
use rit_env::{
    Script, Split,
    rollout::{Job, Rollout},
};
use rit_episode::{Choice, End};
use rit_worlds::starcraft::{Installation, StarCraft, Wanted, endpoint::Endpoint, process};
use std::{ffi::OsString, io, process::ExitCode, sync::Arc};

/// Options of the game's program that the endpoint takes, each with a value; of these it needs none.
const IGNORED: [&str; 10] = [
    "-dataDir",
    "-tempDir",
    "-dataVersion",
    "-displayMode",
    "-windowwidth",
    "-windowheight",
    "-windowx",
    "-windowy",
    "-eglpath",
    "-osmesapath",
];

/// And those without a value.
const IGNORED_ALONE: [&str; 4] = ["-verbose", "-verboseMP", "-headlessNoRender", "-ipv6"];

/// `rit starcraft-endpoint`.
pub async fn endpoint(options: EndpointOptions, logs: LogOptions) -> Result<ExitCode, Failure> {
    logs.start("starcraft-endpoint")?;
    let address = options.listen;
    let endpoint = Endpoint::bind(address, options.to_endpoint()).map_err(|error| {
        Failure::input_message(match error.kind() {
            io::ErrorKind::AddrInUse => format!(
                "{address} is in use: another process listens there; choose another port with --listen, or 0 for any \
                 that is free"
            ),
            _ => format!("cannot listen on {address}: {error}"),
        })
    })?;
    let address = endpoint.address().map_err(Failure::runtime)?;
    let as_a_game = options.as_a_game;
    let serve = move || if as_a_game { endpoint.serve_as_a_game() } else { endpoint.serve() };
    // Caught before it says that it listens.
    let shutdown = shutdown::requested(false);
    output::print(&format!("listening on ws://{address}/sc2api\n"))?;
    tokio::select! {
        served = tokio::task::spawn_blocking(serve) => {
            served.map_err(Failure::runtime)?;
        }
        () = shutdown => {}
    }
    Ok(ExitCode::SUCCESS)
}

/// The game's program is told `-listen HOST -port PORT` and more; an endpoint in its place is told the same.
pub fn translate_game_options(arguments: impl Iterator<Item = OsString>) -> Vec<OsString> {
    let mut arguments: Vec<OsString> = arguments.collect();
    if arguments.get(1).is_none_or(|command| command != "starcraft-endpoint") {
        return arguments;
    }
    let mut rest = arguments.split_off(2).into_iter();
    let (mut host, mut port) = (None, None);
    while let Some(argument) = rest.next() {
        let word = argument.to_str().unwrap_or_default();
        match word {
            "-listen" => host = rest.next(),
            "-port" => port = rest.next(),
            _ if IGNORED.contains(&word) => drop(rest.next()),
            _ if IGNORED_ALONE.contains(&word) => {}
            _ => arguments.push(argument),
        }
    }
    if let Some(port) = port {
        let host = host.unwrap_or_else(|| "127.0.0.1".into());
        let address = format!("{}:{}", host.to_string_lossy(), port.to_string_lossy());
        arguments.extend(["--as-a-game".into(), "--listen".into(), address.into()]);
    }
    arguments
}

/// `rit starcraft-check`: whether real games can be played here, by playing a battle.
pub fn check(options: &StarCraftCheckOptions) -> Result<ExitCode, Failure> {
    let mut settings = options.settings.clone();
    settings.push("environment.backend=starcraft".into());
    let config = experiments::load(&options.experiment, &settings)?.config;
    if let Some(path) = &options.replay {
        new_file::check(path, options.force)?;
    }
    let Some(games) = rit_worlds::games(&config) else {
        return Err(Failure::input_message(format!("{} plays no combat", options.experiment)));
    };
    let games = Arc::new(games);
    let rit_config::StarCraft { map, base_build, data_version, .. } = config.starcraft.clone();
    let installation = StarCraft::check(&Wanted { map, base_build, data_version }).map_err(Failure::input)?;
    output::print(&found(&installation))?;
    let game = games.game().map_err(Failure::runtime)?;
    let (version, build) = game.version();
    output::print(&format!(
        "game          {version}, build {build}, answers\nunit types    {}\n",
        game.custom_types()
    ))?;
    games.give_back(game);
    output::print(&battle(&config, &games)?)?;
    let mut game = games.game().map_err(Failure::runtime)?;
    output::print(&format!("refused       {} orders\n", game.orders_refused()))?;
    if let Some(path) = &options.replay {
        let replay = game.save_replay().map_err(Failure::runtime)?;
        new_file::write("--replay", path, &replay, options.force)?;
        output::print(&format!("replay        {}, {} bytes\n", path.display(), replay.len()))?;
    }
    game.quit();
    Ok(ExitCode::SUCCESS)
}

fn found(installation: &Installation) -> String {
    let Installation { program, map, .. } = installation;
    let notice = installation.notice().map(|notice| format!("notice        {notice}\n"));
    format!(
        "program       {}\nmap           {}\n{}",
        program.display(),
        map.display(),
        notice.unwrap_or_default()
    )
}

/// A battle of random actions, in words.
fn battle(config: &Config, games: &Arc<StarCraft>) -> Result<String, Failure> {
    let task = config.tasks(Split::Training)[0];
    let mut rollout = Rollout::new(vec![task], Arc::<StarCraft>::clone(games), config.seed, true);
    let job = Job { number: 0, weights_version: 0, choice: Choice::Greedy, task: Some(0) };
    let episodes = rollout.roll_all(&mut Script::Random, &[job])?;
    let episode = &episodes[0];
    let end = match (episode.won, episode.end) {
        (true, _) => "won",
        (false, End::Terminated) => "lost",
        (false, End::Truncated) => "cut off at the limit",
    };
    Ok(format!(
        "battle        {task}, random actions: {end} after {} steps, return {:.2}\n",
        episode.steps(),
        episode.total_reward()
    ))
}

/// The hidden command: becomes the game.
pub fn game(options: &GameOptions) -> Failure {
    let GameOptions { parent, program, arguments } = options;
    let error = process::execute(*parent, program, arguments);
    Failure::runtime_message(format!("{}: {error}", program.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_games_own_options_are_understood() {
        let translated = |line: &str| {
            let words = translate_game_options(line.split(' ').map(OsString::from));
            words.iter().map(|word| word.to_string_lossy().into_owned()).collect::<Vec<_>>().join(" ")
        };
        assert_eq!(
            translated(
                "rit starcraft-endpoint --control-enemy sticky -listen 127.0.0.1 -port 5000 -dataDir /opt/sc2/ \
                 -tempDir /tmp/sc-x/ -headlessNoRender -dataVersion ABC"
            ),
            "rit starcraft-endpoint --control-enemy sticky --as-a-game --listen 127.0.0.1:5000"
        );
        for line in ["rit starcraft-endpoint --listen 127.0.0.1:0", "rit train -port 5000", "rit"] {
            assert_eq!(translated(line), line);
        }
    }
}
