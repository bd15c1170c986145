//! Where StarCraft II is on this machine, and whether it can be played: program, version, map.

use std::{
    env, fs, io,
    os::unix::fs::PermissionsExt as _,
    path::{Path, PathBuf},
};

/// Where the task sets' maps come from, for messages.
pub(crate) const MAPS: &str =
    "such as empty_passive.SC2Map of github.com/shariqiqbal2810/REFIL (this project ships none)";

/// The first build whose program speaks the API: 3.16.1.
pub(crate) const BUILD_MIN: u32 = 55_958;

/// Builds that the published environments were used with: 4.6.2 and 4.10.
pub(crate) const BUILDS_USED: [u32; 2] = [69_232, 75_689];

/// Where it is looked for when `SC2PATH` does not say: in the home folder.
const DEFAULT_FOLDER: &str = "StarCraftII";

/// A folder of `Versions`, before its build's number.
const BASE: &str = "Base";

/// What a map's file name ends with.
const MAP_SUFFIX: &str = ".SC2Map";

/// The game that is wanted.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Wanted {
    /// The map: a name in `Maps/SMAC_Maps`, or a path.
    pub map: String,
    /// The build to play; the newest that is there where it is 0.
    pub base_build: u32,
    /// Hash of the data that belongs to a pinned build; the newest where it is empty.
    pub data_version: String,
}

/// What is missing for real games.
#[derive(Debug, thiserror::Error)]
pub enum InstallationError {
    /// Nothing there.
    #[error(
        "no StarCraft II at {folder} ({from}); unpack Blizzard's Linux package, \
         https://github.com/Blizzard/s2client-proto#downloads, and set SC2PATH to its folder; \
         environment.backend=embedded needs none"
    )]
    Missing {
        /// Where it was looked for.
        folder: String,
        /// Who says so.
        from: &'static str,
    },
    /// It is said nowhere where it is.
    #[error("neither SC2PATH nor HOME says where StarCraft II is; set SC2PATH to its folder")]
    NoFolder,
    /// A folder without the game.
    #[error(
        "{folder} has no Versions/{BASE}… with a game; is SC2PATH the folder that holds Versions, Maps and Libs?"
    )]
    NoVersion {
        /// The folder.
        folder: String,
    },
    /// Another build than those there.
    #[error("starcraft.base_build = {wanted} is not installed in {folder}; there are: {known}")]
    Build {
        /// The one that was asked for.
        wanted: u32,
        /// Where it was looked for.
        folder: String,
        /// Those there are.
        known: String,
    },
    /// A build that has no API.
    #[error(
        "the build {build} in {folder} is too old; 3.16.1 (build {BUILD_MIN}) and later will do, best 4.10"
    )]
    TooOld {
        /// The build.
        build: u32,
        /// Where.
        folder: String,
    },
    /// No program.
    #[error(
        "{program} is missing: unpack the Linux package again, or set starcraft.base_build to another build"
    )]
    NoProgram {
        /// Its path.
        program: String,
    },
    /// A program that may not be executed.
    #[error("{program} may not be executed; chmod +x it")]
    NotExecutable {
        /// Its path.
        program: String,
    },
    /// No map.
    #[error("the map {map} cannot be read ({error}); put it there, {MAPS}, or set starcraft.map")]
    Map {
        /// Its path.
        map: String,
        /// Why.
        error: io::Error,
    },
}

/// A game that can be played.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Installation {
    /// The folder that holds `Versions`, `Maps` and `Libs`.
    pub folder: PathBuf,
    /// The program.
    pub program: PathBuf,
    /// Its build.
    pub build: u32,
    /// As [`Wanted::data_version`].
    pub data_version: String,
    /// The map's file.
    pub map: PathBuf,
}

impl Installation {
    /// Looks where `SC2PATH` says, or in `~/StarCraftII`.
    ///
    /// # Errors
    /// When something is missing.
    pub fn find(wanted: &Wanted) -> Result<Self, InstallationError> {
        let set = env::var_os("SC2PATH").filter(|path| !path.is_empty());
        match set {
            Some(path) => Self::find_in(Path::new(&path), "SC2PATH", wanted),
            None => {
                let home = env::var_os("HOME").ok_or(InstallationError::NoFolder)?;
                Self::find_in(&Path::new(&home).join(DEFAULT_FOLDER), "SC2PATH is not set", wanted)
            }
        }
    }

    /// Looks in this folder, which `from` says.
    ///
    /// # Errors
    /// When something is missing.
    pub fn find_in(folder: &Path, from: &'static str, wanted: &Wanted) -> Result<Self, InstallationError> {
        let shown = folder.display().to_string();
        if !folder.is_dir() {
            return Err(InstallationError::Missing { folder: shown, from });
        }
        let builds = builds(&folder.join("Versions"));
        let Some(&newest) = builds.last() else { return Err(InstallationError::NoVersion { folder: shown }) };
        let build = if wanted.base_build == 0 { newest } else { wanted.base_build };
        if !builds.contains(&build) {
            let known = builds.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
            return Err(InstallationError::Build { wanted: build, folder: shown, known });
        }
        if build < BUILD_MIN {
            return Err(InstallationError::TooOld { build, folder: shown });
        }
        let program = folder.join(format!("Versions/{BASE}{build}/SC2_x64"));
        let as_shown = |path: &Path| path.display().to_string();
        match fs::metadata(&program) {
            Ok(file) if file.is_file() && file.permissions().mode() & 0o111 != 0 => {}
            Ok(file) if file.is_file() => {
                return Err(InstallationError::NotExecutable { program: as_shown(&program) });
            }
            _ => return Err(InstallationError::NoProgram { program: as_shown(&program) }),
        }
        let map = map_file(folder, &wanted.map);
        if let Err(error) = fs::File::open(&map) {
            return Err(InstallationError::Map { map: as_shown(&map), error });
        }
        let (folder, data_version) = (folder.to_owned(), wanted.data_version.clone());
        Ok(Self { folder, program, build, data_version, map })
    }

    /// What its user should know of it.
    pub fn notice(&self) -> Option<String> {
        (!BUILDS_USED.contains(&self.build)).then(|| {
            format!(
                "StarCraft II build {}: the published environments were used with {} and {}; others may differ",
                self.build, BUILDS_USED[0], BUILDS_USED[1]
            )
        })
    }
}

/// The builds in a folder, ascending.
fn builds(versions: &Path) -> Vec<u32> {
    let entries = fs::read_dir(versions).into_iter().flatten().flatten();
    let number = |entry: fs::DirEntry| entry.file_name().to_str()?.strip_prefix(BASE)?.parse().ok();
    let mut builds: Vec<u32> = entries.filter_map(number).collect();
    builds.sort_unstable();
    builds
}

fn map_file(folder: &Path, map: &str) -> PathBuf {
    let name = if map.ends_with(MAP_SUFFIX) { map.to_owned() } else { format!("{map}{MAP_SUFFIX}") };
    if map.contains('/') { PathBuf::from(name) } else { folder.join("Maps/SMAC_Maps").join(name) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wanted(map: &str, base_build: u32) -> Wanted {
        Wanted { map: map.into(), base_build, data_version: String::new() }
    }

    /// Why a folder will not do; each line names the thing and the remedy.
    fn refused(folder: &Path, wanted: &Wanted) -> String {
        let error = Installation::find_in(folder, "SC2PATH", wanted).unwrap_err().to_string();
        assert!(!error.contains('\n'), "{error}");
        error
    }

    #[test]
    fn what_is_missing_is_named_one_after_another() {
        let temporary = tempfile::tempdir().unwrap();
        let folder = temporary.path().join("game");
        let new = wanted("empty_passive", 0);
        assert!(
            refused(&folder, &new).contains("no StarCraft II at")
                && refused(&folder, &new).contains("SC2PATH")
        );
        fs::create_dir_all(folder.join("Versions/Base5")).unwrap();
        fs::create_dir(folder.join("Versions/Shaders")).unwrap();
        assert!(
            refused(&folder, &new).contains("the build 5 in") && refused(&folder, &new).contains("too old")
        );
        fs::create_dir(folder.join("Versions/Base75689")).unwrap();
        let program = folder.join("Versions/Base75689/SC2_x64");
        assert!(refused(&folder, &new).contains("SC2_x64 is missing"));
        fs::write(&program, "").unwrap();
        assert!(refused(&folder, &new).contains("may not be executed; chmod +x it"));
        fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).unwrap();
        assert!(refused(&folder, &new).contains("Maps/SMAC_Maps/empty_passive.SC2Map cannot be read"));
        fs::create_dir_all(folder.join("Maps/SMAC_Maps")).unwrap();
        let map = folder.join("Maps/SMAC_Maps/empty_passive.SC2Map");
        fs::write(&map, "a map").unwrap();
        let known = refused(&folder, &wanted("empty_passive", 60_000));
        assert!(known.ends_with("there are: 5, 75689"), "{known}");

        let found = Installation::find_in(&folder, "SC2PATH", &new).unwrap();
        assert_eq!((found.build, &found.program, &found.map), (75_689, &program, &map));
        assert_eq!(found.notice(), None);
        let by_path = wanted(map.to_str().unwrap(), 75_689);
        assert_eq!(Installation::find_in(&folder, "SC2PATH", &by_path).unwrap().map, map);
        let untested = Installation { build: 90_000, ..found };
        assert!(untested.notice().unwrap().starts_with("StarCraft II build 90000"));
    }
}
