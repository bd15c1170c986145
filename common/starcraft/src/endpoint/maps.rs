//! What the endpoint knows of maps: which of SMAC's own bring their armies along, and where types lie in a row.

use rit_env::combat::UnitType::{self, Colossus, Marauder, Marine, Medivac, Stalker, Zealot};
use std::path::Path;

/// Units of each type.
pub type Army = &'static [(UnitType, usize)];

/// The armies that a map brings along: the allies' and the enemies'.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Armies {
    /// Player 1's.
    pub allies: Army,
    /// Player 2's.
    pub enemies: Army,
}

/// SMAC's maps of units that the simulator knows.
const SMAC: [(&str, Army, Army); 17] = [
    ("3m", &[(Marine, 3)], &[(Marine, 3)]),
    ("8m", &[(Marine, 8)], &[(Marine, 8)]),
    ("25m", &[(Marine, 25)], &[(Marine, 25)]),
    ("5m_vs_6m", &[(Marine, 5)], &[(Marine, 6)]),
    ("8m_vs_9m", &[(Marine, 8)], &[(Marine, 9)]),
    ("10m_vs_11m", &[(Marine, 10)], &[(Marine, 11)]),
    ("27m_vs_30m", &[(Marine, 27)], &[(Marine, 30)]),
    ("MMM", &[(Marauder, 2), (Marine, 7), (Medivac, 1)], &[(Marauder, 2), (Marine, 7), (Medivac, 1)]),
    ("MMM2", &[(Marauder, 2), (Marine, 7), (Medivac, 1)], &[(Marauder, 3), (Marine, 8), (Medivac, 1)]),
    ("2s3z", &[(Stalker, 2), (Zealot, 3)], &[(Stalker, 2), (Zealot, 3)]),
    ("3s5z", &[(Stalker, 3), (Zealot, 5)], &[(Stalker, 3), (Zealot, 5)]),
    ("3s5z_vs_3s6z", &[(Stalker, 3), (Zealot, 5)], &[(Stalker, 3), (Zealot, 6)]),
    ("1c3s5z", &[(Colossus, 1), (Stalker, 3), (Zealot, 5)], &[(Colossus, 1), (Stalker, 3), (Zealot, 5)]),
    ("3s_vs_3z", &[(Stalker, 3)], &[(Zealot, 3)]),
    ("3s_vs_4z", &[(Stalker, 3)], &[(Zealot, 4)]),
    ("3s_vs_5z", &[(Stalker, 3)], &[(Zealot, 5)]),
    ("2m_vs_1z", &[(Marine, 2)], &[(Zealot, 1)]),
];

/// The first of the nine custom types in a map that all scenarios share: in the authors' map, and in REFIL's and all
/// others.
const AUTHORS_TYPES: u32 = 1970;
const TYPES: u32 = 1935;

/// What the endpoint makes of a map.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Map {
    /// The armies that it brings along; without any it is empty.
    pub armies: Option<Armies>,
    /// The first of its custom types.
    pub types: u32,
}

/// By the map's file.
pub fn of(path: &str) -> Map {
    let name = Path::new(path).file_stem().and_then(|name| name.to_str()).unwrap_or_default();
    let armies = SMAC.iter().find(|(known, ..)| *known == name);
    let types = if name == "full_map_template" { AUTHORS_TYPES } else { TYPES };
    Map { armies: armies.map(|&(_, allies, enemies)| Armies { allies, enemies }), types }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maps_are_known_by_their_file() {
        let known = of("/opt/StarCraftII/Maps/SMAC_Maps/2s3z.SC2Map").armies.unwrap();
        assert_eq!((known.allies, known.enemies), ([(Stalker, 2), (Zealot, 3)].as_slice(), known.allies));
        assert_eq!(of("SMAC_Maps/empty_passive.SC2Map"), Map { armies: None, types: 1935 });
        assert_eq!(of("full_map_template.SC2Map"), Map { armies: None, types: 1970 });
        assert_eq!(of(""), Map { armies: None, types: 1935 });
    }
}
