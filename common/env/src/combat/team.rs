//! Teams and the four task sets made of them: training tasks and testing tasks in the order of the paper's generator.

use super::unit::UnitType;
use std::fmt;

/// The combat task sets of the paper's section VI-C.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum CombatSet {
    /// 3 to 8 marines.
    Marines,
    /// 3 to 8 stalkers and zealots.
    StalkersZealots,
    /// 3 to 6 marines and marauders, up to two medivacs.
    MarinesMaraudersMedivacs,
    /// 3 to 6 stalkers and zealots, up to two colossi.
    ColossiStalkersZealots,
}

/// Most units of one side.
pub const TEAM_MAX: usize = 8;

/// How many units of each type, in the order of [`UnitType::ALL`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Team([u8; UnitType::ALL.len()]);

/// Why a team cannot fight in a set.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TeamError {
    /// Its name is not one.
    #[error(
        "{0:?} is no team; write counts and letters such as 5s3z or 3m-vs-4m: m marine, M marauder, v medivac, s stalker, z zealot, c colossus"
    )]
    Name(String),
    /// It has no unit or too many.
    #[error("{name} has {units} units; a side has 1 to {TEAM_MAX}")]
    Size {
        /// The team.
        name: String,
        /// How many units it has.
        units: usize,
    },
    /// It has a type that the set's features cannot show.
    #[error("{name} has a unit of type {letter:?}, which {set} does not have; it has {}", letters(*set))]
    Type {
        /// The team.
        name: String,
        /// The type's letter.
        letter: char,
        /// The set.
        set: CombatSet,
    },
    /// It cannot win.
    #[error("{name} has no unit that can attack")]
    Unarmed {
        /// The team.
        name: String,
    },
}

fn letters(set: CombatSet) -> String {
    set.types().iter().map(|kind| kind.letter().to_string()).collect::<Vec<_>>().join(", ")
}

impl Team {
    /// How many of a type.
    pub fn count(self, kind: UnitType) -> usize {
        usize::from(self.0[kind as usize])
    }

    /// How many units.
    pub fn len(self) -> usize {
        self.0.iter().map(|&count| usize::from(count)).sum()
    }

    /// Whether no unit is in it.
    pub fn is_empty(self) -> bool {
        self.len() == 0
    }

    /// Sum of health and shield, by the numbers the maps have.
    fn vitality(self) -> f64 {
        let of_one = |kind: UnitType| {
            let stats = kind.stats(super::unit::StatsVersion::Liberty);
            stats.health + stats.shield
        };
        UnitType::ALL.into_iter().map(|kind| self.count(kind) as f64 * of_one(kind)).sum()
    }

    /// The team of this name, such as `3s2z1c`.
    ///
    /// # Errors
    /// When the name is not one, or the set has no such team.
    pub fn parse(name: &str, set: CombatSet) -> Result<Self, TeamError> {
        let wrong = || TeamError::Name(name.to_owned());
        let mut team = Self::default();
        let mut rest = name;
        while !rest.is_empty() {
            let digits = rest.bytes().take_while(u8::is_ascii_digit).count();
            // `03m` would be another name of `3m`; there is no team of none.
            if rest.starts_with('0') {
                return Err(wrong());
            }
            let count: u8 = rest[..digits].parse().map_err(|_| wrong())?;
            let letter = rest[digits..].chars().next().ok_or_else(wrong)?;
            let kind = UnitType::ALL.into_iter().find(|kind| kind.letter() == letter).ok_or_else(wrong)?;
            if !set.types().contains(&kind) {
                return Err(TeamError::Type { name: name.to_owned(), letter, set });
            }
            if team.count(kind) > 0 {
                return Err(wrong());
            }
            team.0[kind as usize] = count;
            rest = &rest[digits + letter.len_utf8()..];
        }
        let units = team.len();
        if !(1..=TEAM_MAX).contains(&units) {
            return Err(TeamError::Size { name: name.to_owned(), units });
        }
        if team.count(UnitType::Medivac) == units {
            return Err(TeamError::Unarmed { name: name.to_owned() });
        }
        Ok(team)
    }
}

impl fmt::Display for Team {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for kind in UnitType::ALL.into_iter().filter(|&kind| self.count(kind) > 0) {
            write!(f, "{}{}", self.count(kind), kind.letter())?;
        }
        Ok(())
    }
}

impl CombatSet {
    /// Every set.
    pub const ALL: [Self; 4] =
        [Self::Marines, Self::StalkersZealots, Self::MarinesMaraudersMedivacs, Self::ColossiStalkersZealots];

    /// Whether its teams may have units of this type.
    pub fn has(self, kind: UnitType) -> bool {
        self.core().contains(&kind) || self.support() == Some(kind)
    }

    /// The types that every team has some of: two, or one and none.
    fn core(self) -> &'static [UnitType] {
        match self {
            Self::Marines => &[UnitType::Marine],
            Self::MarinesMaraudersMedivacs => &[UnitType::Marine, UnitType::Marauder],
            Self::StalkersZealots | Self::ColossiStalkersZealots => &[UnitType::Stalker, UnitType::Zealot],
        }
    }

    fn support(self) -> Option<UnitType> {
        match self {
            Self::Marines | Self::StalkersZealots => None,
            Self::MarinesMaraudersMedivacs => Some(UnitType::Medivac),
            Self::ColossiStalkersZealots => Some(UnitType::Colossus),
        }
    }

    /// The types of the set, in the order in which groups are created.
    pub fn types(self) -> Vec<UnitType> {
        self.core().iter().copied().chain(self.support()).collect()
    }

    /// The types in the order of their one-hot; of none where there is one type only.
    pub fn one_hot(self) -> &'static [UnitType] {
        match self {
            Self::Marines => &[],
            Self::StalkersZealots => &[UnitType::Zealot, UnitType::Stalker],
            Self::MarinesMaraudersMedivacs => &[UnitType::Marine, UnitType::Marauder, UnitType::Medivac],
            Self::ColossiStalkersZealots => &[UnitType::Colossus, UnitType::Zealot, UnitType::Stalker],
        }
    }

    /// Whether units have shields, and so a feature for them.
    pub fn has_shields(self) -> bool {
        matches!(self, Self::StalkersZealots | Self::ColossiStalkersZealots)
    }

    /// Whether the set has medivacs: a side of medivacs alone has lost.
    pub fn has_medivacs(self) -> bool {
        self == Self::MarinesMaraudersMedivacs
    }

    /// Most steps of an episode.
    pub fn steps_max(self) -> usize {
        if self == Self::Marines { 100 } else { 150 }
    }

    /// A: no-op, stop, four moves, one for each enemy's tag; with medivacs one for each ally's tag too.
    pub fn n_actions(self) -> usize {
        6 + if self.has_medivacs() { 2 * TEAM_MAX } else { TEAM_MAX }
    }

    /// Features of an entity, without the last action: tag, available actions from 2 on, type, health, shield,
    /// energy, cooldown, place twice.
    pub fn feature_dim(self) -> usize {
        let shield = usize::from(self.has_shields());
        2 * TEAM_MAX + self.n_actions() - 2 + self.one_hot().len() + 1 + shield + 1 + 1 + 4
    }

    /// What a win by killing everybody of the set's greatest team comes to, before scaling to 20: one number for
    /// all tasks of the set.
    pub fn max_reward(self) -> f64 {
        let types = |team: &Team| UnitType::ALL.into_iter().filter(|&kind| team.count(kind) > 0).count();
        let greatest = self.teams().into_iter().rev().max_by_key(|team| (types(team), team.len()));
        greatest.map_or(0.0, |team| TEAM_MAX as f64 * 10.0 + 200.0 + team.vitality())
    }

    /// Every team of the set: by core size, then the first core type's count descending, then support ascending.
    pub fn teams(self) -> Vec<Team> {
        let support_max = if self.support().is_some() { 2 } else { 0 };
        let sizes = if support_max > 0 { 3..=6 } else { 3..=8 };
        let mut teams = Vec::new();
        for size in sizes {
            let firsts = if self.core().len() == 1 { size..=size } else { 0..=size };
            for first in firsts.rev() {
                for support in 0..=support_max {
                    let mut team = Team::default();
                    team.0[self.core()[0] as usize] = first;
                    if let Some(&second) = self.core().get(1) {
                        team.0[second as usize] = size - first;
                    }
                    if let Some(kind) = self.support() {
                        team.0[kind as usize] = support;
                    }
                    teams.push(team);
                }
            }
        }
        teams
    }

    /// How many of [`Self::teams`], the first ones, are for training.
    pub fn n_training(self) -> usize {
        self.teams().len() * 4 / 5
    }
}

impl fmt::Display for CombatSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Marines => "3-8m",
            Self::StalkersZealots => "3-8sz",
            Self::MarinesMaraudersMedivacs => "3-8MMM",
            Self::ColossiStalkersZealots => "3-8csz",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The table of the four sets: tasks, training tasks, limit, actions, features, greatest reward.
    #[test]
    fn sets_are_those_of_the_paper() {
        let table = [
            (CombatSet::Marines, 6, 4, 100, 14, 35, 640.0),
            (CombatSet::StalkersZealots, 39, 31, 150, 14, 38, 1550.0),
            (CombatSet::MarinesMaraudersMedivacs, 66, 52, 150, 22, 46, 930.0),
            (CombatSet::ColossiStalkersZealots, 66, 52, 150, 14, 39, 1930.0),
        ];
        for (set, tasks, training, limit, actions, features, reward) in table {
            assert_eq!((set.teams().len(), set.n_training()), (tasks, training), "{set}");
            assert_eq!((set.steps_max(), set.n_actions(), set.feature_dim()), (limit, actions, features));
            assert_eq!(set.max_reward(), reward, "{set}");
        }
        let names: Vec<String> = CombatSet::StalkersZealots.teams().iter().map(Team::to_string).collect();
        assert_eq!(names[..5], ["3s", "2s1z", "1s2z", "3z", "4s"]);
        let names: Vec<String> =
            CombatSet::ColossiStalkersZealots.teams().iter().map(Team::to_string).collect();
        assert_eq!(names[..5], ["3s", "3s1c", "3s2c", "2s1z", "2s1z1c"]);
    }

    #[test]
    fn names_lead_back_and_impossible_teams_are_refused_by_name() {
        for set in CombatSet::ALL {
            for team in set.teams() {
                assert_eq!(Team::parse(&team.to_string(), set), Ok(team));
            }
        }
        let refused = |name: &str, set| Team::parse(name, set).unwrap_err().to_string();
        assert_eq!(refused("9m", CombatSet::Marines), "9m has 9 units; a side has 1 to 8");
        assert_eq!(
            refused("2m1z", CombatSet::Marines),
            "2m1z has a unit of type 'z', which 3-8m does not have; it has m"
        );
        assert_eq!(refused("2v", CombatSet::MarinesMaraudersMedivacs), "2v has no unit that can attack");
        for name in ["", "m", "3", "0m", "03m", "+3m", "3m3m", "3x", "-3m", "300m", "3é"] {
            assert!(Team::parse(name, CombatSet::Marines).is_err(), "{name}");
        }
    }
}
