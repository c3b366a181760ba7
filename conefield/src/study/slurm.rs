//! A Slurm script for a job array, each job a share of a study.

use conefield_core::{Error, Result};
use std::path::Path;

/// Settings of the jobs.
pub struct Jobs<'a> {
    /// The study's name.
    pub name: &'a str,
    /// The words that start this program.
    pub program: &'a [String],
    /// The study's file.
    pub study: &'a Path,
    /// The folder for the results, which all jobs must be able to access.
    pub output: &'a Path,
    /// Number of jobs that share the runs.
    pub count: usize,
    /// General options for every command, as on the command line.
    pub general: &'a [String],
}

impl Jobs<'_> {
    /// The script. A job that is killed and requeued, or submitted again, repeats no finished run; the last job to end
    /// writes the table.
    pub fn script(&self) -> Result<String> {
        let absolute = |path: &Path| std::path::absolute(path).map_err(|e| Error::io(path, e));
        let quoted = |text: &str| {
            shlex::try_quote(text).map(|q| q.into_owned()).map_err(|e| {
                Error::invalid("--slurm", "a name", format!("{text:?}: {e}"), "a name that a shell accepts")
            })
        };
        let path = |path: &Path| quoted(&absolute(path)?.display().to_string());
        let job: String = self.name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect();
        let program: Vec<String> = self.program.iter().map(|w| quoted(w)).collect::<Result<_>>()?;
        let program = program.join(" ");
        let general: Vec<String> = self.general.iter().map(|g| quoted(g)).collect::<Result<_>>()?;
        let mut general: String = general.iter().map(|g| format!(" {g}")).collect();
        if !self.general.iter().any(|g| g.starts_with("--threads")) {
            general += " --threads \"${SLURM_CPUS_PER_TASK:-1}\"";
        }
        let (study, output) = (path(self.study)?, path(self.output)?);
        let count = self.count;
        Ok(format!(
            "#!/bin/bash
# Submit with: sbatch FILE, with your cluster's options before FILE, such as --partition, --gres or --cpus-per-task.
# If submitted again, it continues where it stopped.
#SBATCH --job-name={job}
#SBATCH --array=1-{count}
#SBATCH --output=%x-%A_%a.log
#SBATCH --open-mode=append
#SBATCH --requeue
# A minute before its time limit, a job ends after its current step and keeps a checkpoint.
#SBATCH --signal=B:TERM@60
exec {program}{general} study {study} -o {output} --shard \"$SLURM_ARRAY_TASK_ID/{count}\"
"
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_quoted_and_whole() {
        let jobs = Jobs {
            name: "my study",
            program: &["/bin/python".into(), "-m".into(), "conefield".into()],
            study: Path::new("/a b/s.toml"),
            output: Path::new("/out"),
            count: 3,
            general: &["--quiet".into()],
        };
        let script = jobs.script().unwrap();
        assert!(script.starts_with("#!/bin/bash\n") && script.contains("#SBATCH --array=1-3\n"), "{script}");
        assert!(script.contains("--job-name=my-study\n"), "{script}");
        let last = script.lines().last().unwrap();
        let want = "exec /bin/python -m conefield --quiet --threads \"${SLURM_CPUS_PER_TASK:-1}\" study '/a b/s.toml' -o /out --shard \"$SLURM_ARRAY_TASK_ID/3\"";
        assert_eq!(last, want);
    }
}
